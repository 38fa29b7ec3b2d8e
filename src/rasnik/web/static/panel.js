// What a channel tells of itself: overview, readouts, alarms, tiles.

import { decimalsFor, grouped, short } from "./numbers.js";
import { QUANTITIES } from "./curves.js";

const STATES = {
  starting: ["starting", "warn"], running: ["running", "good"], lost: ["camera lost", "bad"],
  ended: ["ended", "warn"], failed: ["failed", "bad"], stopped: ["stopped", "warn"],
};

/** One word on a channel and its colour; alarms come first. */
export function stateOf(channel) {
  if (channel.alarms.length) return ["alarm", "bad"];
  if (channel.state === "running" && !channel.locked) return ["no lock", "bad"];
  return STATES[channel.state] ?? [channel.state, "warn"];
}

function element(name, text, className = "") {
  const made = document.createElement(name);
  made.textContent = text;
  made.className = className;
  return made;
}

/** The row of channels; `choose(name)` when one is pressed. */
export class Overview {
  constructor(choose) {
    this.place = document.getElementById("channels");
    this.choose = choose;
    this.cards = new Map();
  }

  show(channels, chosen) {
    for (const channel of channels) {
      const card = this.cards.get(channel.name) ?? this.card(channel.name);
      const [word, colour] = stateOf(channel);
      card.button.setAttribute("aria-current", String(channel.name === chosen));
      card.state.textContent = word;
      card.state.className = `state ${colour}`;
      const { x_nm, y_nm } = channel.relative;
      card.numbers.textContent = `x ${grouped(x_nm)}, y ${grouped(y_nm)} nm, ${short(channel.frame_rate_hz)} Hz${channel.recording ? ", ● rec" : ""}`;
    }
  }

  card(name) {
    const button = document.createElement("button");
    button.type = "button";
    button.onclick = () => this.choose(name);
    const state = element("span", "", "state");
    const numbers = element("span", "", "numbers");
    button.append(element("span", name, "name"), state, numbers);
    this.place.append(button);
    const card = { button, state, numbers };
    this.cards.set(name, card);
    return card;
  }
}

export class Panel {
  constructor() {
    this.alarms = document.getElementById("alarms");
    this.tiles = document.getElementById("tiles");
    this.tile = new Map();
    this.told = "";
  }

  show(channel, channels) {
    this.showAlarms(channels);
    this.showReadouts(channel);
    this.showTiles(channel);
    this.showActions(channel);
  }

  showAlarms(channels) {
    const lines = channels.flatMap((channel) => {
      const messages = [...channel.alarms];
      if (channel.message && ["lost", "failed"].includes(channel.state)) messages.push(channel.message);
      if (channel.recording_message) messages.push(channel.recording_message);
      return messages.map((message) => `${channel.name}: ${message}`);
    });
    const text = lines.join("\n");
    if (text === this.told) return; // what is read aloud is read once
    this.told = text;
    this.alarms.hidden = !lines.length;
    this.alarms.replaceChildren(...lines.map((line) => element("p", `⚠ ${line}`)));
    document.title = (lines.length ? "⚠ " : "") + "rasnik";
  }

  showReadouts(channel) {
    const zeroed = channel.zero_um.some((v) => v !== 0);
    for (const { key, unit } of QUANTITIES) {
      const box = document.querySelector(`.readout[data-key="${key}"]`);
      const sigma = channel.relative[`sigma_${key}`];
      const value = grouped(channel.locked ? channel.relative[key] : null, decimalsFor(sigma));
      box.querySelector("output").replaceChildren(value + "\u2009", element("span", unit));
      const from = zeroed ? "from the zero" : key.startsWith("scale") ? "from S = 1" : "from the mask's origin";
      box.querySelector("small").textContent = `± ${short(sigma, 2)} ${unit}, ${from}`;
    }
  }

  showTiles(channel) {
    const lost = channel.lost_in_transfer + channel.lost_by_time + channel.dropped;
    const chi = channel.chi2_ndf;
    const [word, colour] = stateOf(channel);
    this.set("state", channel.message ? `${word}: ${channel.message}` : word, colour, true);
    this.set("lock", channel.locked ? "locked" : "no position", channel.locked ? "good" : "bad");
    this.set("frame rate", `${short(channel.frame_rate_hz, 4)} Hz`);
    this.set("latency", `${short(channel.latency_median_ms, 2)} ms`);
    this.set("latency, 99 %", `${short(channel.latency_p99_ms, 2)} ms`);
    this.set("frames", grouped(channel.frames));
    this.set("lost", grouped(lost), lost ? "warn" : "");
    this.set("χ² / ndf", short(chi), chi > 1.5 ? "warn" : "");
    this.set("exposure", `${short(channel.exposure_us, 4)} µs`);
    this.set("light, dark", `${short(channel.light_level)}, ${short(channel.dark_level)}`);
    this.set("reconnected", grouped(channel.reconnects), channel.reconnects ? "warn" : "");
    this.set("camera", channel.camera + (channel.metrology ? "" : " (not for metrology)"), channel.metrology ? "" : "warn", true);
    this.set("losses", `${channel.lost_in_transfer} in transfer, ${channel.lost_by_time} by time, ${channel.dropped} not analysed in time`, "", true);
    this.set("flags", channel.flags.join(", ").replaceAll("_", " ") || "none", "", true);
  }

  set(name, text, colour = "", wide = false) {
    let value = this.tile.get(name);
    if (!value) {
      const box = document.createElement("div");
      box.className = wide ? "wide" : "";
      value = document.createElement("dd");
      box.append(element("dt", name), value);
      this.tiles.append(box);
      this.tile.set(name, value);
    }
    if (value.textContent !== text) value.textContent = text;
    value.className = colour;
  }

  showActions(channel) {
    const record = document.getElementById("record");
    record.setAttribute("aria-pressed", String(channel.recording));
    record.lastElementChild.textContent = channel.recording ? "Stop recording" : "Start recording";
    document.getElementById("zero").disabled = !channel.locked;
    const rows = `${grouped(channel.recorded)} rows`;
    document.getElementById("recording").textContent = channel.recording
      ? `${rows} in ${channel.recording_file}` : channel.recorded ? `Not recording; ${rows} before.` : "Not recording.";
    const exposure = document.getElementById("exposure");
    if (document.activeElement !== exposure && !exposure.dataset.changed && channel.exposure_us !== null) {
      exposure.value = String(Number(channel.exposure_us.toPrecision(5)));
    }
    if (channel.keep_exposure !== null) document.getElementById("keep").checked = channel.keep_exposure;
  }
}

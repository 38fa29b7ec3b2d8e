// The page: what comes from the station goes to its parts, what is pressed goes to the station.

import { Curves } from "./curves.js";
import { Feed } from "./feed.js";
import { Overview, Panel } from "./panel.js";
import { Picture } from "./picture.js";
import { Spectrum } from "./spectrum.js";

const by = (id) => document.getElementById(id);
let chosen = location.hash.slice(1) || null;
let channels = [];
let recording = false;
let quiet = 0;

// ---------------------------------------------------------------------- the station

/** Ask the interface; the answer, or null after telling what is wrong. */
async function ask(path, options = {}) {
  try {
    const reply = await fetch(path, { cache: "no-store", ...options });
    if (reply.status === 401) location.href = "/login";
    const content = await reply.json();
    if (reply.ok) return content;
    tell(content.error, true);
  } catch {
    tell("The station does not answer.", true);
  }
  return null;
}

function act(action, content = {}) {
  return ask(`/api/channels/${encodeURIComponent(chosen)}/${action}`, {
    method: "POST",
    headers: { "Content-Type": "application/json", "X-Rasnik": "1" },
    body: JSON.stringify(content),
  });
}

function tell(text, bad = false) {
  const notice = by("notice");
  notice.textContent = text;
  notice.classList.toggle("bad", bad);
  notice.hidden = false;
  clearTimeout(quiet);
  quiet = setTimeout(() => { notice.hidden = true; }, bad ? 12000 : 5000);
}

// ---------------------------------------------------------------------- the parts

const curves = new Curves((start, end, points) =>
  ask(`/api/channels/${encodeURIComponent(chosen)}/history?start=${start}&end=${end}&points=${Math.round(points)}`));
const spectrum = new Spectrum();
const picture = new Picture();
const panel = new Panel();
const overview = new Overview(choose);
const updates = { image: 0, curves: 0 };
window.rasnik = { updates }; // for those who measure the page

let waiting = false; // rows since the last drawing

const feed = new Feed({
  status(header) {
    channels = header.channels;
    curves.setClock(header.host_time_s);
    if (!channels.some((channel) => channel.name === chosen)) choose(channels[0].name);
    const channel = channels.find((one) => one.name === chosen);
    recording = channel.recording;
    overview.show(channels, chosen);
    panel.show(channel, channels);
  },
  rows(header, arrays) {
    if (header.channel !== chosen) return;
    curves.add(header, arrays);
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(() => { waiting = false; if (curves.drawIfLive()) updates.curves += 1; });
    }
  },
  async image(header, arrays) {
    try {
      if (header.channel === chosen) {
        await picture.show(header, arrays);
        updates.image += 1;
      }
    } finally {
      feed.seen();
    }
  },
  spectrum(header, arrays) {
    if (header.channel === chosen) spectrum.show(header, arrays);
  },
}, (on) => {
  by("connection").textContent = on ? "connected" : "not connected; trying again";
  by("connection").classList.toggle("on", on);
  if (!on) ask("/health");
});

function choose(name) {
  chosen = name;
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  curves.clear();
  spectrum.clear();
  wish();
}

/** A page that is not seen needs no pictures. */
function wish() {
  const width = Math.round(Math.min(1024, by("image").clientWidth * (window.devicePixelRatio || 1)));
  const seen = !document.hidden;
  feed.wish({
    channel: chosen, image_hz: seen ? 20 : 0, rows_hz: seen ? 25 : 1, rows_s: 60,
    spectrum_s: seen ? 20 : 0, width: Math.max(320, width),
  });
}

document.addEventListener("visibilitychange", wish);

// ---------------------------------------------------------------------- the buttons

by("record").onclick = async () => {
  const stop = recording;
  if (await act(stop ? "stop-recording" : "start-recording")) tell(stop ? "Recording stopped." : "Recording started.");
};
by("zero").onclick = async () => { if (await act("zero")) tell("Counting from here."); };
by("clear-zero").onclick = async () => { if (await act("clear-zero")) tell("Counting from the mask's origin."); };
by("snapshot").onclick = async () => {
  const saved = await act("snapshot");
  if (saved) tell(`Saved as ${saved.file}`);
};
by("keep-frames").onclick = async () => { if (await act("keep-frames")) tell("The raw frames around this moment are kept."); };
by("exposure").oninput = () => { by("exposure").dataset.changed = "1"; };
by("exposure-form").onsubmit = async (event) => {
  event.preventDefault();
  const done = await act("exposure", { exposure_us: Number(by("exposure").value) });
  delete by("exposure").dataset.changed;
  if (done) tell(`Exposure set to ${by("exposure").value} µs.`);
};
by("keep").onchange = async () => {
  const on = by("keep").checked;
  if (await act("keep-exposure", { on })) tell(on ? "The exposure is kept at the working point." : "The exposure stays as it is.");
};

if (chosen) wish();
ask("/api/station").then((station) => { if (station) by("station").textContent = station.name; });

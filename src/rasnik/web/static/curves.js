// Curves against time: the last seconds as they come, or a part of the record.

import { clock, day, grouped } from "./numbers.js";

export const QUANTITIES = [
  { key: "x_nm", name: "x", unit: "nm", colour: "--x", least: 2 },
  { key: "y_nm", name: "y", unit: "nm", colour: "--y", least: 2 },
  { key: "scale_ppm", name: "S", unit: "ppm", colour: "--scale", least: 1 },
  { key: "theta_urad", name: "θz", unit: "µrad", colour: "--theta", least: 1 },
];
const SPANS = [
  { label: "10 s", live: 10 }, { label: "30 s", live: 30 }, { label: "60 s", live: 60 },
  { label: "10 min", past: 600 }, { label: "1 h", past: 3600 }, { label: "24 h", past: 86400 },
];
const LONGEST_LIVE_S = 60;
const MOST_ROWS = 120000;

/** The last rows, in arrays that are moved together now and then. */
class Rows {
  constructor() {
    this.clear();
  }

  clear() {
    this.count = 0;
    this.size = 4096;
    this.columns = {};
    for (const key of ["time_s", ...QUANTITIES.map((q) => q.key)]) this.columns[key] = new Float64Array(this.size);
  }

  add(arrays) {
    const more = arrays.time_s.length;
    // The station's time was set back: rows before that have no place on the same axis.
    if (this.count && more && arrays.time_s[0] < this.columns.time_s[this.count - 1]) this.clear();
    if (this.count + more > this.size) this.makeRoom(more);
    for (const key of Object.keys(this.columns)) this.columns[key].set(arrays[key], this.count);
    this.count += more;
  }

  makeRoom(more) {
    const last = this.count ? this.columns.time_s[this.count - 1] : 0;
    const drop = Math.max(this.after(last - LONGEST_LIVE_S), this.count + more - MOST_ROWS, 0);
    const kept = this.count - drop;
    if (2 * (kept + more) > this.size) this.size = 2 * (kept + more);
    for (const key of Object.keys(this.columns)) {
      const moved = new Float64Array(this.size);
      moved.set(this.columns[key].subarray(drop, this.count));
      this.columns[key] = moved;
    }
    this.count = kept;
  }

  /** Add a constant to a column: the zero has changed. */
  shift(key, by) {
    for (let k = 0; k < this.count; k++) this.columns[key][k] += by;
  }

  /** The first row at or after a time. */
  after(time_s) {
    let low = 0, high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.columns.time_s[middle] < time_s) low = middle + 1; else high = middle;
    }
    return low;
  }
}

function withGaps(values) {
  for (const value of values) if (Number.isNaN(value)) return Array.from(values, (v) => (Number.isNaN(v) ? null : v));
  return values;
}

function limits(...columns) {
  let low = Infinity, high = -Infinity;
  for (const values of columns) for (const v of values) {
    if (v === null) continue;
    if (v < low) low = v;
    if (v > high) high = v;
  }
  return low <= high ? [low, high] : null;
}

export class Curves {
  constructor(ask) {
    this.ask = ask; // (start, end, points) -> history
    this.rows = new Rows();
    this.view = { live: 30 };
    this.past = []; // views to go back to
    this.ahead_s = 0; // of the station's clock before this one
    this.place = document.getElementById("curves");
    this.range = document.getElementById("range");
    this.makeButtons();
    this.make();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.make());
    new ResizeObserver(() => this.fit()).observe(this.place);
    setInterval(() => this.refresh(), 3000);
  }

  /** Times are those of the station, whatever the clock of the viewer says. */
  setClock(host_time_s) {
    this.ahead_s = host_time_s - Date.now() / 1000;
  }

  // --------------------------------------------------------------- what it looks like

  makeButtons() {
    const place = document.getElementById("spans");
    this.buttons = SPANS.map((span) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = span.label;
      button.title = span.live ? "as it comes" : "from the record";
      button.onclick = () => this.look({ live: span.live, past: span.past });
      place.append(button);
      return [button, span];
    });
    this.back = document.createElement("button");
    this.back.type = "button";
    this.back.textContent = "Back";
    this.back.onclick = () => this.look(this.past.pop() ?? { live: 30 }, true);
    place.append(this.back);
  }

  make() {
    this.plots?.forEach((plot) => plot.destroy());
    this.place.replaceChildren();
    const sync = uPlot.sync("time");
    this.plots = QUANTITIES.map((quantity, k) => this.plot(quantity, k === QUANTITIES.length - 1, sync));
    this.mark();
    if (this.view.live) this.draw(); else this.show(this.history);
  }

  plot(quantity, last, sync) {
    const style = getComputedStyle(document.documentElement);
    const colour = style.getPropertyValue(quantity.colour).trim();
    const ink = style.getPropertyValue("--soft").trim(), grid = style.getPropertyValue("--grid").trim();
    const box = document.createElement("div");
    box.className = "plot";
    box.dataset.key = quantity.key;
    box.setAttribute("role", "img");
    box.setAttribute("aria-label", `${quantity.name} in ${quantity.unit} against time; drag over it to zoom`);
    const title = document.createElement("div");
    title.className = "title";
    title.textContent = `${quantity.name} / ${quantity.unit}`;
    box.append(title);
    this.place.append(box);
    const line = { stroke: colour, width: 1, points: { show: false } };
    const edge = { stroke: "transparent", width: 0, points: { show: false }, show: false };
    return new uPlot({
      width: this.place.clientWidth || 600,
      height: this.height(last),
      padding: [8, 8, 0, 0],
      legend: { show: false },
      cursor: { y: false, sync: { key: sync.key, setSeries: false }, drag: { x: true, y: false, setScale: false }, points: { show: false } },
      scales: { x: { time: false, range: (u, low, high) => this.window ?? [low, high] }, y: { range: (u) => u.shown ?? [-1, 1] } },
      series: [{}, line, edge, edge],
      bands: [{ series: [3, 2], fill: colour + "40" }],
      axes: [
        { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 }, size: last ? 28 : 6, space: 70,
          values: (u, ticks) => ticks.map((t) => (last ? this.tick(t, ticks) : "")) },
        { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { show: false }, size: 78, space: 28,
          values: (u, ticks) => ticks.map((v) => grouped(v, stepDecimals(ticks))) },
      ],
      hooks: { setSelect: [(u) => this.selected(u)], ready: [(u) => { u.over.addEventListener("dblclick", () => this.back.click()); selectByFinger(u.over); }] },
    }, [[], [], [], []], box);
  }

  height(last) {
    return (window.innerWidth < 900 ? 118 : 138) + (last ? 22 : 0);
  }

  tick(time_s, ticks) {
    const step = ticks.length > 1 ? ticks[1] - ticks[0] : 1;
    return step >= 86400 ? day(time_s) : clock(time_s, step < 1 ? (step < 0.1 ? 3 : 1) : 0);
  }

  fit() {
    const width = this.place.clientWidth;
    this.plots.forEach((plot, k) => {
      if (width && plot.width !== width) plot.setSize({ width, height: this.height(k === this.plots.length - 1) });
    });
  }

  // ----------------------------------------------------------------- what is looked at

  look(view, back = false) {
    if (!back && JSON.stringify(view) !== JSON.stringify(this.view)) this.past.push(this.view);
    this.past = this.past.slice(-20);
    this.view = view;
    this.mark();
    if (view.live) this.draw(); else this.load();
  }

  mark() {
    for (const [button, span] of this.buttons) {
      const pressed = this.view.live ? span.live === this.view.live : Boolean(span.past) && span.past === this.view.past;
      button.setAttribute("aria-pressed", String(pressed));
    }
    this.back.hidden = !this.past.length;
    if (this.view.live) this.range.textContent = "As it comes. Drag over a curve to look closer, in the record.";
  }

  selected(plot) {
    const { left, width } = plot.select;
    if (width < 8) return;
    const start = plot.posToVal(left, "x"), end = plot.posToVal(left + width, "x");
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.look({ start, end });
  }

  refresh() {
    if (this.view.past && !document.hidden) this.load();
  }

  async load() {
    const view = this.view;
    const now = Date.now() / 1000 + this.ahead_s;
    const [start, end] = view.past ? [now - view.past, now] : [view.start, view.end];
    this.range.textContent = `From the record: ${day(start)} ${clock(start, 1)} to ${clock(end, 1)}.`;
    const points = Math.min(2000, Math.max(200, this.place.clientWidth));
    const found = await this.ask(start, end, points);
    if (view !== this.view) return;
    if (!found) return;
    this.show({ ...found, window: [start, end] });
    if (!found.time_s.length) this.range.textContent += " Nothing was recorded then.";
  }

  show(history) {
    this.history = history;
    if (!history) return;
    this.window = history.window;
    QUANTITIES.forEach(({ key, least }, k) => {
      const [low, mean, high] = ["min", "mean", "max"].map((kind) => history[`${key}_${kind}`]);
      this.put(this.plots[k], [history.time_s, mean, low, high], limits(low, high), least, true);
    });
  }

  // ------------------------------------------------------------------------ as it comes

  clear() {
    this.rows.clear();
    this.zero = null;
    this.past = [];
    this.history = null;
    this.view = { live: this.view.live ?? 30 };
    this.mark();
  }

  add(header, arrays) {
    if (header.first) this.rows.clear();
    else if (this.zero) this.follow(header.zero);
    this.zero = header.zero;
    this.rows.add(arrays);
  }

  /** Draw what has come; false where a part of the record is looked at. */
  drawIfLive() {
    if (this.view.live) this.draw();
    return Boolean(this.view.live);
  }

  /** Rows that are here already count from the zero that is in force now. */
  follow(zero) {
    const gains = [1e3, 1e3, 1e6 / zero[2], 1e6];
    zero.forEach((value, k) => {
      if (value === this.zero[k]) return;
      if (k === 2) this.rescale(this.zero[2], value);
      else this.rows.shift(QUANTITIES[k].key, (this.zero[k] - value) * gains[k]);
    });
  }

  rescale(before, after) {
    const column = this.rows.columns.scale_ppm;
    for (let k = 0; k < this.rows.count; k++) column[k] = ((column[k] * 1e-6 + 1) * before / after - 1) * 1e6;
  }

  draw() {
    const { count, columns } = this.rows;
    if (!count) return;
    const end = columns.time_s[count - 1], start = end - this.view.live;
    const first = this.rows.after(start);
    this.window = [start, end];
    const time = columns.time_s.subarray(first, count);
    QUANTITIES.forEach(({ key, least }, k) => {
      const values = withGaps(columns[key].subarray(first, count));
      this.put(this.plots[k], [time, values, values, values], limits(values), least, false);
    });
  }

  put(plot, data, found, least, band) {
    if (found) {
      const middle = (found[0] + found[1]) / 2;
      const half = Math.max((found[1] - found[0]) / 2 * 1.15, least / 2);
      plot.shown = [middle - half, middle + half];
    }
    if (plot.series[2].show !== band) { plot.setSeries(2, { show: band }); plot.setSeries(3, { show: band }); }
    plot.setData(data);
  }
}

/** A finger that moves sideways selects as a mouse does; up and down it moves the page. */
function selectByFinger(over) {
  let begun = null;
  const pass = (kind, { clientX, clientY }) => // uPlot takes no notice of a mouse that has not moved
    over.dispatchEvent(new MouseEvent(kind, { clientX, clientY, movementX: 1, bubbles: true }));
  over.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" || !event.isPrimary) return;
    begun = { clientX: event.clientX, clientY: event.clientY };
    over.setPointerCapture(event.pointerId);
    pass("mousemove", begun);
    pass("mousedown", begun);
  });
  over.addEventListener("pointermove", (event) => { if (begun && event.isPrimary) pass("mousemove", event); });
  const end = (event, at) => {
    if (!begun || !event.isPrimary) return;
    pass("mousemove", at);
    pass("mouseup", at);
    begun = null;
  };
  over.addEventListener("pointerup", (event) => end(event, event));
  over.addEventListener("pointercancel", (event) => end(event, begun)); // the page moved instead
}

function stepDecimals(ticks) {
  const step = ticks.length > 1 ? ticks[1] - ticks[0] : 1;
  return Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
}

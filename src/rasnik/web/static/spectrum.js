// The live amplitude spectral density beside the bound.

import { short } from "./numbers.js";

const CHOICES = [
  { label: "x, y", unit: "nm/√Hz", keys: ["x_nm", "y_nm"], names: ["x", "y"], colours: ["--x", "--y"] },
  { label: "S", unit: "ppm/√Hz", keys: ["scale_ppm"], names: ["S"], colours: ["--scale"] },
  { label: "θz", unit: "µrad/√Hz", keys: ["theta_urad"], names: ["θz"], colours: ["--theta"] },
];

export class Spectrum {
  constructor() {
    this.place = document.getElementById("spectrum");
    this.note = document.getElementById("spectrum-note");
    this.choice = CHOICES[0];
    const place = document.getElementById("spectrum-choice");
    this.buttons = CHOICES.map((choice) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = choice.label;
      button.onclick = () => { this.choice = choice; this.make(); };
      place.append(button);
      return [button, choice];
    });
    this.make();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.make());
    new ResizeObserver(() => {
      const width = this.place.clientWidth;
      if (width && width !== this.plot.width) this.plot.setSize({ width, height: 250 });
    }).observe(this.place);
  }

  make() {
    this.plot?.destroy();
    this.place.replaceChildren();
    for (const [button, choice] of this.buttons) button.setAttribute("aria-pressed", String(choice === this.choice));
    const style = getComputedStyle(document.documentElement);
    const ink = style.getPropertyValue("--soft").trim(), grid = style.getPropertyValue("--grid").trim();
    const colours = this.choice.colours.map((name) => style.getPropertyValue(name).trim());
    const line = (stroke) => ({ stroke, width: 1.25, points: { show: false } });
    const axis = (values, size) => ({ stroke: ink, size, grid: { stroke: grid, width: 1 }, ticks: { show: false }, values });
    const powers = (u, ticks) => ticks.map((v) => (v !== null && Number.isInteger(Math.round(1e6 * Math.log10(v)) / 1e6) ? short(v, 1) : ""));
    this.plot = new uPlot({
      width: this.place.clientWidth || 600,
      height: 250,
      padding: [8, 12, 0, 0],
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false } },
      scales: { x: { time: false, distr: 3, range: (u, low, high) => (high > low && low > 0 ? [low, high] : [0.1, 100]) }, y: { distr: 3 } },
      series: [{}, ...colours.map(line), ...colours.map((c) => ({ ...line(c), dash: [6, 5], width: 1.5 }))],
      axes: [
        { ...axis(powers, 44), label: "frequency / Hz", labelSize: 18, labelFont: "12px system-ui" },
        { ...axis(powers, 62), label: this.choice.unit, labelSize: 18, labelFont: "12px system-ui" },
      ],
    }, [[], ...colours.map(() => []), ...colours.map(() => [])], this.place);
    this.place.setAttribute("role", "img");
    this.place.setAttribute("aria-label", `Amplitude spectral density of ${this.choice.names.join(" and ")} in ${this.choice.unit}; dashed: the bound`);
    if (this.last) this.show(...this.last);
  }

  clear() {
    this.last = null;
    this.make();
    this.note.textContent = "";
  }

  show(header, arrays) {
    if (header.error) {
      this.note.textContent = header.error.charAt(0).toUpperCase() + header.error.slice(1) + ".";
      return;
    }
    this.last = [header, arrays];
    const { keys, names, unit } = this.choice;
    const bounds = keys.map((key) => header.bounds[key]);
    this.plot.setData([
      arrays.frequency_hz,
      ...keys.map((key) => positive(arrays[key])),
      ...bounds.map((b) => Array(arrays.frequency_hz.length).fill(b > 0 ? b : null)),
    ]);
    const told = names.map((name, k) => `${name} ${short(bounds[k])}`).join(", ");
    this.note.textContent = `One-sided, over the last 20 s. Dashed: what the noise of the pixels allows (${told} ${unit}).`;
  }
}

function positive(values) {
  return Array.from(values, (v) => (v > 0 ? v : null));
}

// The frame with what was fitted over it, and the histogram.

import { clock, grouped } from "./numbers.js";

const LATTICE = "rgba(80, 230, 120, 0.4)";
const CODE = "#ff9d2e";

function sized(canvas, ratio) {
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return [canvas.getContext("2d"), width, height];
}

function drawLines(context, lines, sx, sy) {
  context.beginPath();
  for (let k = 0; k < lines.length; k += 4) {
    context.moveTo(lines[k] * sx, lines[k + 1] * sy);
    context.lineTo(lines[k + 2] * sx, lines[k + 3] * sy);
  }
  context.stroke();
}

function drawFields(context, fields, sx, sy) {
  context.beginPath();
  for (let k = 0; k < fields.length; k += 8) {
    context.moveTo(fields[k] * sx, fields[k + 1] * sy);
    for (let c = 2; c < 8; c += 2) context.lineTo(fields[k + c] * sx, fields[k + c + 1] * sy);
    context.closePath();
  }
  context.stroke();
}

export class Picture {
  constructor() {
    this.canvas = document.getElementById("image");
    this.histogram = document.getElementById("histogram");
    this.caption = document.getElementById("image-caption");
    this.saturation = document.getElementById("saturation");
    this.lattice = document.getElementById("show-lattice");
    this.code = document.getElementById("show-code");
  }

  /** Draw a frame; resolves when it is on the screen. */
  async show(header, arrays) {
    const bitmap = await createImageBitmap(new Blob([arrays.jpeg], { type: "image/jpeg" }));
    this.canvas.style.aspectRatio = `${header.width} / ${header.height}`;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [context, width, height] = sized(this.canvas, ratio);
    context.drawImage(bitmap, 0, 0, width, height);
    bitmap.close();
    const sx = width / header.width, sy = height / header.height;
    if (this.lattice.checked) {
      context.strokeStyle = LATTICE;
      context.lineWidth = 1;
      drawLines(context, arrays.lines, sx, sy);
    }
    if (this.code.checked) {
      context.strokeStyle = CODE;
      context.lineWidth = 1.5 * ratio;
      drawFields(context, arrays.code, sx, sy);
    }
    this.drawHistogram(arrays.counts, header.saturated_fraction);
    this.caption.textContent =
      `frame ${grouped(header.number)}, ${clock(header.time_s, 3)}, ${header.width} × ${header.height}`;
    this.tellSaturation(header);
  }

  tellSaturation(header) {
    const percent = 100 * header.saturated_fraction;
    this.saturation.textContent = percent > 0
      ? `saturated: ${percent < 0.01 ? "< 0.01" : percent.toFixed(2)} % of the pixels`
      : "no pixel saturated";
    this.saturation.classList.toggle("bad", percent > 0.1);
    document.getElementById("full-scale").textContent = grouped(header.full_scale);
  }

  drawHistogram(counts, saturated) {
    const [context, width, height] = sized(this.histogram, window.devicePixelRatio || 1);
    const style = getComputedStyle(document.documentElement);
    context.clearRect(0, 0, width, height);
    const most = Math.max(...counts) || 1;
    const step = width / counts.length;
    context.fillStyle = style.getPropertyValue("--accent");
    counts.forEach((count, k) => {
      if (k === counts.length - 1 && saturated > 0) context.fillStyle = style.getPropertyValue("--bad");
      const tall = Math.sqrt(count / most) * (height - 2); // the root: rare levels are seen too
      context.fillRect(k * step + 0.5, height - tall, Math.max(1, step - 1), tall);
    });
    context.fillStyle = style.getPropertyValue("--line");
    context.fillRect(0, height - 1, width, 1);
  }
}

// Numbers as they are read.

const SPACE = "\u202f";

/** 1234567.8 -> "1 234 567.8"; a dash for what is not known. */
export function grouped(value, decimals = 0) {
  if (value === null || !Number.isFinite(value)) return "–";
  const [whole, part] = Math.abs(value).toFixed(decimals).split(".");
  const sign = value < 0 && Number(whole + (part ?? "")) !== 0 ? "−" : "";
  const text = whole.replace(/\B(?=(\d{3})+$)/g, SPACE);
  return sign + text + (part ? "." + part : "");
}

/** Decimals that a standard deviation leaves. */
export function decimalsFor(sigma) {
  if (!(sigma > 0)) return 1;
  return Math.min(4, Math.max(0, 1 - Math.floor(Math.log10(sigma))));
}

/** Three digits: 0.0123, 1.23, 123, 1 230. */
export function short(value, digits = 3) {
  if (value === null || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(Math.abs(value))));
  return grouped(value, Math.min(decimals, 8));
}

/** 14:03:05.250 */
export function clock(time_s, decimals = 0) {
  const date = new Date(1000 * time_s);
  const two = (n) => String(n).padStart(2, "0");
  const part = decimals ? "." + String(date.getMilliseconds()).padStart(3, "0").slice(0, decimals) : "";
  return `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}${part}`;
}

export function day(time_s) {
  return new Date(1000 * time_s).toLocaleDateString(undefined, { day: "numeric", month: "short" });
}

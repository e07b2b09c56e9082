// Numbers, times and bytes as people read them.

/** 12,345. */
export const count = (value) => Number(value).toLocaleString("en-US");

/** 12.3 k, 4.5 M: four characters or so. */
export function short(value) {
  for (const [unit, size] of [["G", 1e9], ["M", 1e6], ["k", 1e4]]) {
    if (value >= size) {
      const scaled = value / (unit === "k" ? 1e3 : size);
      return `${scaled.toFixed(scaled < 100 ? 1 : 0)} ${unit}`;
    }
  }
  return count(Math.round(value * 10) / 10);
}

/** 1.5 GiB. */
export function bytes(value) {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let at = 0;
  while (value >= 1024 && at < units.length - 1) {
    value /= 1024;
    at += 1;
  }
  return `${at === 0 || value >= 100 ? Math.round(value) : value.toFixed(1)} ${units[at]}`;
}

/** 3 d 4 h, 2 h 05 m, 3 m 20 s, 12 s, 0.4 s: two units at most. */
export function span(ms) {
  if (ms < 0) ms = 0;
  const seconds = ms / 1_000;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes} m ${String(Math.floor(seconds % 60)).padStart(2, "0")} s`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return `${hours} h ${String(minutes % 60).padStart(2, "0")} m`;
  return `${Math.floor(hours / 24)} d ${hours % 24} h`;
}

let skew = 0;
/** Notes what time it is at the coordinator. */
export function setClock(now) {
  skew = now - Date.now();
}
/** Milliseconds since 1970 by the coordinator's clock. */
export const now = () => Date.now() + skew;

/** How long ago. */
export const ago = (at) => (at ? `${span(now() - at)} ago` : "never");

/** 27 Nov 14:05:09. */
export function moment(at) {
  if (!at) return "never";
  return new Date(at).toLocaleString("en-GB", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit" });
}

/** 41.5 %. */
export const share = (part, whole) => (whole > 0 ? `${((100 * part) / whole).toFixed(part === whole || part === 0 ? 0 : 1)} %` : "0 %");

/** A file's name is the last part of its path. */
export const fileName = (path) => path.split("/").pop();

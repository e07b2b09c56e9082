// The light: a sky or a dropped map, turned about the up axis and tinted.

import { get } from "/dashboard/api.js";
import { fromHdr } from "/dashboard/viewer/hdr.js";
import { transfer } from "/dashboard/viewer/sh.js";

const BANDS = 6;
const NAMES = { sky: "Clear sky", sunset: "Sunset", overcast: "Overcast" };

/** The environments that there are, and those that are dropped. */
export class Lights {
  constructor() {
    this.all = new Map();
  }

  async load() {
    for (const sky of await get("/v1/skies")) this.all.set(sky.name, { name: NAMES[sky.name] ?? sky.name, light: sky.light, sunny: sky.sun });
    const uniform = Array.from({ length: 36 }, (_, at) => (at === 0 ? 2 * Math.sqrt(Math.PI) : 0));
    this.all.set("uniform", { name: "Even white", light: [uniform, uniform, uniform], sunny: false });
  }

  /** Adds a Radiance map; answers its key. */
  async drop(file) {
    const light = await fromHdr(await file.arrayBuffer());
    const key = `file:${file.name}`;
    this.all.set(key, { name: file.name, light, sunny: false });
    return key;
  }

  /** The matrix from visibility to radiance, for what a preview's header says. */
  matrix(state, header) {
    const { light, sunny } = this.all.get(state.env) ?? this.all.get("sky");
    // A sun would ring in few bands: it gets all of them, tapered, as `pantaray relight` does
    const lightBands = sunny ? BANDS : header.bands;
    const factor = (l) => (sunny && l > 0 ? Math.sin((Math.PI * l) / BANDS) / ((Math.PI * l) / BANDS) : 1);
    const tapered = light.map((color) => color.map((value, at) => value * factor(Math.floor(Math.sqrt(at)))));
    return transfer({ light: tapered, lightBands, bands: header.bands, cosineWeighted: header.cosineWeighted, mapFromScene: mapFromScene(header.zUp, state.rotation), tint: state.tint });
  }

  /** The light in a direction of the scene, three colours: for the ball and the background. */
  towards(state, zUp) {
    const { light } = this.all.get(state.env) ?? this.all.get("sky");
    return { light, turn: mapFromScene(zUp, state.rotation) };
  }
}

/** Turns a direction of the scene into the map's frame: +y up, -z in its middle. */
export function mapFromScene(zUp, degrees) {
  const [sin, cos] = [Math.sin((degrees * Math.PI) / 180), Math.cos((degrees * Math.PI) / 180)];
  return (x, y, z) => {
    if (zUp) [y, z] = [z, -y];
    return [cos * x - sin * z, y, sin * x + cos * z];
  };
}

// What a view is: everything that its address says, so that a link restores it.

/** Reads the address's fragment. */
export function readState() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const vector = (name) => {
    const values = (asked.get(name) ?? "").split(",").map(Number);
    return values.length === 3 && values.every(Number.isFinite) ? values : null;
  };
  const number = (name, otherwise) => (asked.has(name) && Number.isFinite(Number(asked.get(name))) ? Number(asked.get(name)) : otherwise);
  return {
    show: asked.get("show") ?? "lit", env: asked.get("env") ?? "sky", rotation: number("rot", 0), stops: number("stops", 0), tint: vector("tint") ?? [1, 1, 1],
    compare: asked.get("compare") ?? "one", other: asked.get("with") ?? "", gain: number("gain", 4), eye: vector("eye"), at: vector("at"), fov: number("fov", 35),
  };
}

/** The address of a view. */
export function writeState(state, camera) {
  const values = (list) => list.map((value) => Number(value.toPrecision(9))).join(",");
  const said = new URLSearchParams({ show: state.show, env: state.env, rot: state.rotation, stops: state.stops, eye: values(camera.eye), at: values(camera.target), fov: camera.fov });
  if (state.tint.some((value) => value !== 1)) said.set("tint", values(state.tint));
  if (state.other) said.set("with", state.other), said.set("compare", state.compare), said.set("gain", state.gain);
  return `${location.pathname}${location.search}#${said}`;
}

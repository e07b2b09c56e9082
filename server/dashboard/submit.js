// A scene's files: what it names, which of the dropped files those are, and their way to the coordinator.

import { change, query, upload } from "/dashboard/api.js";
import { sha256 } from "/dashboard/sha256.js";

/** Bytes of a dropped file at most: the browser holds it while it is hashed. */
const FILE_BYTES_MAX = 2 ** 30;

/** The relative paths that a scene names; those below the coordinator's own folders need no upload. */
export function named(scene) {
  const parsed = new DOMParser().parseFromString(scene, "application/xml");
  const error = parsed.querySelector("parsererror");
  if (error) throw new Error(`the scene is no XML: ${error.textContent.split("\n")[0].slice(0, 200)}`);
  if (parsed.documentElement.localName !== "scene") throw new Error(`the file is no scene: its root is “${parsed.documentElement.localName}”`);
  const files = [...parsed.querySelectorAll("[file]")].map((element) => element.getAttribute("file"));
  return [...new Set(files)].filter((path) => path && !path.startsWith("root:"));
}

/** The bake sets and shaders of a scene, for a first look. */
export function about(scene) {
  const parsed = new DOMParser().parseFromString(scene, "application/xml");
  const names = (selector) => [...parsed.querySelectorAll(selector)].map((element) => element.getAttribute("name"));
  return { sets: names("bakeset"), geometries: names("geometry"), cameras: names("camera") };
}

/** Every file of a drop, folders included, by its path. */
export async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (entries.length === 0) return [...transfer.files].map((file) => [file.name, file]);
  const found = [];
  const walk = async (entry) => {
    if (entry.isFile) found.push([entry.fullPath.replace(/^\//, ""), await new Promise((take, fail) => entry.file(take, fail))]);
    else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((take, fail) => reader.readEntries(take, fail));
        if (some.length === 0) break;
        for (const one of some) await walk(one);
      }
    }
  };
  for (const entry of entries) await walk(entry);
  return found;
}

/** The dropped file that a path of the scene means: the same end of the path, or at least the same name. */
export function match(path, files) {
  const tail = path.replace(/^\.\//, "");
  return files.find(([name]) => name === tail || name.endsWith(`/${tail}`))?.[1] ?? files.find(([name]) => name.split("/").pop() === tail.split("/").pop())?.[1];
}

/** Uploads what the project does not have; answers the paths with their hashes. */
export async function send(paths, files, project, progress) {
  const hashes = {};
  const contents = new Map();
  for (const path of paths) {
    const file = match(path, files);
    if (!file) throw new Error(`the scene names ${path}: drop that file, too`);
    if (file.size > FILE_BYTES_MAX) throw new Error(`${path} is larger than a browser should hold: use “pantaray submit”`);
    progress(`Reading ${path} …`);
    const hash = await sha256(await file.arrayBuffer());
    hashes[path.replace(/^\.\//, "")] = hash;
    contents.set(hash, [path, file]);
  }
  if (contents.size === 0) return hashes;
  const { missing } = await change("POST", "/v1/assets/missing", { project, sha256: [...contents.keys()] });
  for (const hash of missing) {
    const [path, file] = contents.get(hash);
    progress(`Uploading ${path} …`);
    await upload(query(`/v1/assets/${hash}`, { project }), file);
  }
  return hashes;
}

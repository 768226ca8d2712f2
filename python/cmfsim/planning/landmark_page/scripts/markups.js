// Landmark files of 3D Slicer: written, and read with everything that could be wrong found.

import { _ } from "./elements.js";
import { descriptionOf, originOf } from "./site_states.js";

const SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#";
const FRAMES = { LPS: 1, 1: 1, RAS: -1, 0: -1 };
const UNITS = { mm: 1, cm: 10, m: 1000, um: 0.001 };

/** The text of a file of sites: {name, point (null if missing), state, error, doubt}. */
export function markupsText(sites) {
  const controlPoints = sites.map(({ name, point, ...state }, i) => ({
    id: String(i + 1),
    label: name,
    description: descriptionOf(state),
    position: (point ?? [0, 0, 0]).map((v) => Math.round(v * 1e4) / 1e4),
    positionStatus: point ? "defined" : "undefined",
  }));
  const markup = { type: "Fiducial", coordinateSystem: "LPS", coordinateUnits: "mm", controlPoints };
  return JSON.stringify({ "@schema": SCHEMA, markups: [markup] }, null, 1);
}

/** The points of a file by label: {label, point (LPS mm), origin}; those never placed are left out. */
export function markupsOf(text) {
  let document;
  try { document = JSON.parse(text); } catch { throw new Error(_`it is not a .mrk.json file of 3D Slicer (no JSON)`); }
  const markups = document?.markups;
  if (!Array.isArray(markups)) throw new Error(_`it is not a .mrk.json file of 3D Slicer (no list of markups)`);
  const found = [];
  let stated = true;
  for (const markup of markups) {
    const frame = markup?.coordinateSystem ?? "";
    if (frame !== "" && !Object.hasOwn(FRAMES, frame)) throw new Error(_`its frame is ${JSON.stringify(frame)}: LPS and RAS are read`);
    stated &&= frame !== "";
    const sign = frame === "" ? 1 : FRAMES[frame];
    const units = [markup?.coordinateUnits ?? "mm"].flat()[0];
    if (!Object.hasOwn(UNITS, units)) throw new Error(_`its unit is ${JSON.stringify(units)}: mm, cm, m and um are read`);
    for (const entry of markup?.controlPoints ?? []) {
      if ((entry?.positionStatus ?? "defined") !== "defined") continue;
      const { label, position } = entry;
      if (typeof label !== "string" || !label.trim()) throw new Error(_`it has a point without a label`);
      if (!Array.isArray(position) || position.length !== 3 || !position.every(Number.isFinite)) {
        throw new Error(_`the point ${JSON.stringify(label)} is not at three numbers`);
      }
      const point = position.map((v, i) => UNITS[units] * (i < 2 ? sign * v : v));
      found.push({ label: label.trim(), point, origin: originOf(String(entry.description ?? "")) });
    }
  }
  if (!found.length) throw new Error(_`it contains no placed points`);
  return { points: found, stated };
}

// The measures of the face, as cmfsim.face_measures has them: the same sites, the same formulas.

import { DEGREE } from "./rigid.js";

const minus = (a, b) => a.map((v, i) => v - b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);

/** The angle at `vertex` between `a` and `b`, degrees. */
function angle(a, vertex, b) {
  const u = minus(a, vertex);
  const v = minus(b, vertex);
  const cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  return Math.atan2(Math.hypot(...cross), dot(u, v)) / DEGREE;
}

/** How far a point lies in front of the line from `upper` to `lower`, in the sagittal plane, mm. */
function inFront(point, upper, lower) {
  const [, py, pz] = minus(point, upper);
  const [, dy, dz] = minus(lower, upper);
  return (py * dz - pz * dy) / Math.hypot(dy, dz);
}

const distance = (a, b) => Math.hypot(...minus(a, b));
const height = (a, b) => a[2] - b[2];
const FORMULAS = { angle, in_front: inFront, distance, height };

/** The value of each measure at sites by name; null where a site is absent. */
export function measure(definitions, sites) {
  return definitions.map(({ formula, sites: names }) => {
    const places = names.map((name) => sites[name]);
    return places.every(Boolean) ? FORMULAS[formula](...places) : null;
  });
}

// The measures of face and occlusion, as the package has them: the same sites, the same formulas.

import { DEGREE, moved } from "./rigid.js";

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

// Of occlusion, as cmfsim.occlusion has them: points with their places forwards, up and to the left.
const OCCLUSAL = {
  along: (a, b, c, d) => {
    const [x, y] = minus(b, a);
    return (x * (c[0] - d[0]) + y * (c[1] - d[1])) / Math.hypot(x, y);
  },
  across: (a, b, c, d) => {
    const [x, y] = minus(b, a);
    return (x * (c[1] - d[1]) - y * (c[0] - d[0])) / Math.hypot(x, y);
  },
  left: (a) => a[2],
  cant: (a, b) => Math.atan2(a[1] - b[1], a[2] - b[2]) / DEGREE,
};

/** A measure of occlusion: its points are shares of places that move with segments. */
function occlusal({ formula, points, offset, axes }, motions) {
  const places = points.map((parts) => {
    const sum = [0, 0, 0];
    for (const { segment, share, place } of parts) {
      const to = motions && segment !== null ? moved(motions[segment], place) : place;
      to.forEach((v, k) => { sum[k] += share * v; });
    }
    return [dot(sum, axes.forwards), dot(sum, axes.up), dot(sum, axes.left)];
  });
  return OCCLUSAL[formula](...places) - offset;
}

/** The value of each measure at sites by name, under motions; null where a site is absent. */
export function measure(definitions, sites, motions) {
  return definitions.map((definition) => {
    if (definition.points) return occlusal(definition, motions);
    const places = definition.sites.map((name) => sites[name]);
    return !definition.absent && places.every(Boolean) ? FORMULAS[definition.formula](...places) : null;
  });
}

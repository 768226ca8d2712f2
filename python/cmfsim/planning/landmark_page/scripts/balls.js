// Sites as balls in the picture: coloured by their state, hidden by what lies in front of them.

import { _ } from "./elements.js";

export const STATES = {
  missing: { label: _`missing`, colour: "#8b3fa8" },
  doubtful: { label: _`doubtful`, colour: "#d55e00" },
  filled: { label: _`filled in`, colour: "#56b4e9" },
  moved: { label: _`moved`, colour: "#56b4e9" },
  proposed: { label: _`proposed`, colour: "#0072b2" },
  accepted: { label: _`accepted`, colour: "#009e73" },
  placed: { label: _`placed`, colour: "#009e73" },
};
// Radius as a share of the height of the picture, and its bounds, mm.
const SIZE = 0.0085, LEAST = 0.7, MOST = 2.6;
const CHOSEN = 1.35;

/** The radius of a ball, mm. */
export const ballRadius = (camera, chosen) =>
  Math.max(LEAST, Math.min(MOST, SIZE * camera.span)) * (chosen ? CHOSEN : 1);

/** Where a ball of this radius is drawn: a motion of the unit ball. */
export const ballMotion = ([x, y, z], r) => [r, 0, 0, x, 0, r, 0, y, 0, 0, r, z, 0, 0, 0, 1];

/** The places and triangles of a ball of radius 1. */
export function unitBall(rings = 8, steps = 14) {
  const places = [], triangles = [];
  for (let r = 0; r <= rings; r++) {
    for (let s = 0; s < steps; s++) {
      const [a, b] = [(Math.PI * r) / rings, (2 * Math.PI * s) / steps];
      places.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
      if (r === rings) continue;
      const next = (s + 1) % steps;
      const [p, q] = [r * steps, (r + 1) * steps];
      triangles.push(p + s, q + s, q + next, p + s, q + next, p + next);
    }
  }
  return { places: Float32Array.from(places), triangles: Uint32Array.from(triangles) };
}

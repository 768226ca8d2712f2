// Motions in a surgeon's numbers, with the signs of cmfsim.clinical_motion.
//
// Millimetres are those of one point: forwards is −P, up +S, left +L. Turns are the components of
// the rotation vector in degrees: pitch with the front up, yaw with the front to the left, roll
// with the left side up.

import { _ } from "./elements.js";
import { motionOf, moved, rotationOf, rotationVector } from "./rigid.js";

export const NUMBERS = [
  { key: "forwards", label: _`Forwards`, unit: "mm", low: _`back`, high: _`forwards` },
  { key: "up", label: _`Up`, unit: "mm", low: _`down`, high: _`up` },
  { key: "left", label: _`To the left`, unit: "mm", low: _`right`, high: _`left` },
  { key: "pitch", label: _`Pitch`, unit: "°", low: _`front down`, high: _`front up` },
  { key: "yaw", label: _`Yaw`, unit: "°", low: _`front to right`, high: _`front to left` },
  { key: "roll", label: _`Roll`, unit: "°", low: _`left side down`, high: _`left side up` },
];
const SHIFTS = { forwards: [1, -1], up: [2, 1], left: [0, 1] };
const TURNS = { pitch: [0, -1], yaw: [2, 1], roll: [1, -1] };

/** The six numbers of a motion at a point. */
export function clinicalNumbers(motion, point) {
  const to = moved(motion, point);
  const turn = rotationVector(motion);
  const found = {};
  for (const [key, [axis, sign]] of Object.entries(SHIFTS)) {
    found[key] = sign * (to[axis] - point[axis]);
  }
  for (const [key, [axis, sign]] of Object.entries(TURNS)) found[key] = sign * turn[axis];
  return found;
}

/** The motion with these six numbers at a point. */
export function motionFromNumbers(numbers, point) {
  const to = [...point];
  const turn = [0, 0, 0];
  for (const [key, [axis, sign]] of Object.entries(SHIFTS)) to[axis] += sign * numbers[key];
  for (const [key, [axis, sign]] of Object.entries(TURNS)) turn[axis] = sign * numbers[key];
  return motionOf(rotationOf(turn), point, to);
}

/**
 * The motion with one number changed, measured at `point`.
 *
 * A change in mm moves the whole segment; a change of a turn leaves `centre` where the motion has
 * taken it. Both points are given before the motion.
 */
export function withNumber(motion, point, centre, key, value) {
  const numbers = { ...clinicalNumbers(motion, point), [key]: value };
  if (key in SHIFTS) return motionFromNumbers(numbers, point);
  const rotation = motionFromNumbers(numbers, [0, 0, 0]).filter((_, i) => i < 12 && i % 4 < 3);
  return motionOf(rotation, centre, moved(motion, centre));
}

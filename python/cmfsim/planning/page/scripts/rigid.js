// Rigid motions: 4 × 4 matrices, row by row, x ↦ R x + t, in LPS mm.

export const STAYS = Object.freeze([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
export const DEGREE = Math.PI / 180;

/** The image of a point. */
export function moved(m, [x, y, z]) {
  return [0, 4, 8].map((r) => m[r] * x + m[r + 1] * y + m[r + 2] * z + m[r + 3]);
}

/** The images of points, three numbers each. */
export function movedAll(m, places) {
  const out = new Float32Array(places.length);
  for (let i = 0; i < places.length; i += 3) {
    for (let r = 0; r < 3; r++) out[i + r] = m[4 * r] * places[i] + m[4 * r + 1] * places[i + 1] + m[4 * r + 2] * places[i + 2] + m[4 * r + 3];
  }
  return out;
}

/** The matrix with the rotation (9 numbers) that takes point `from` to point `to`. */
export function motionOf(rotation, from, to) {
  const out = [...STAYS];
  for (let r = 0; r < 3; r++) {
    let turned = 0;
    for (let c = 0; c < 3; c++) {
      out[4 * r + c] = rotation[3 * r + c];
      turned += rotation[3 * r + c] * from[c];
    }
    out[4 * r + 3] = to[r] - turned;
  }
  return out;
}

/** The inverse of a rigid motion. */
export function inverse(m) {
  const out = [...STAYS];
  for (let r = 0; r < 3; r++) {
    for (let c = 0; c < 3; c++) out[4 * r + c] = m[4 * c + r];
    out[4 * r + 3] = -(m[r] * m[3] + m[4 + r] * m[7] + m[8 + r] * m[11]);
  }
  return out;
}

/** The motion `b` followed by the motion `a`. */
export function product(a, b) {
  const out = new Array(16).fill(0);
  for (let r = 0; r < 4; r++)
    for (let c = 0; c < 4; c++)
      for (let k = 0; k < 4; k++) out[4 * r + c] += a[4 * r + k] * b[4 * k + c];
  return out;
}

/** The rotation (9 numbers) about a rotation vector in degrees (Rodrigues 1840). */
export function rotationOf(vector) {
  const angle = Math.hypot(...vector);
  if (angle === 0) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
  const [x, y, z] = vector.map((v) => v / angle);
  const s = Math.sin(angle * DEGREE);
  const c = 1 - Math.cos(angle * DEGREE);
  return [
    1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
    c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
    c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
  ];
}

/** The rotation vector of a motion, degrees: axis times angle, the angle from 0 to 180. */
export function rotationVector(m) {
  const twice = [m[9] - m[6], m[2] - m[8], m[4] - m[1]];
  const sine = Math.hypot(...twice);
  const cosine = m[0] + m[5] + m[10] - 1;
  const angle = Math.atan2(sine, cosine) / DEGREE;
  if (sine < 1e-9) {
    // No turn, or a half turn: its axis is along the longest column of R + I.
    if (cosine > 0) return twice.map((v) => v / 2 / DEGREE);
    const columns = [0, 1, 2].map((c) => [0, 1, 2].map((r) => m[4 * r + c] + (r === c ? 1 : 0)));
    const longest = columns.reduce((a, b) => (Math.hypot(...a) >= Math.hypot(...b) ? a : b));
    return longest.map((v) => (v / Math.hypot(...longest)) * 180);
  }
  return twice.map((v) => (v / sine) * angle);
}

/** How far a matrix is from a rotation: the largest entry of RᵀR − I, and 2 for a mirror. */
export function rigidError(m) {
  let worst = 0;
  for (let a = 0; a < 3; a++)
    for (let b = 0; b < 3; b++) {
      const dot = m[a] * m[b] + m[4 + a] * m[4 + b] + m[8 + a] * m[8 + b];
      worst = Math.max(worst, Math.abs(dot - (a === b ? 1 : 0)));
    }
  const determinant =
    m[0] * (m[5] * m[10] - m[6] * m[9]) - m[1] * (m[4] * m[10] - m[6] * m[8]) +
    m[2] * (m[4] * m[9] - m[5] * m[8]);
  return determinant > 0 ? worst : 2;
}

/** The part `share` of a motion: its turn about a point, and the way of that point. */
export function partOf(m, share, point) {
  const to = moved(m, point);
  const vector = rotationVector(m).map((v) => v * share);
  return motionOf(rotationOf(vector), point, point.map((p, i) => p + share * (to[i] - p)));
}

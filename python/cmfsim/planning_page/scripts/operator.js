// The plan operator: displacements of the skin's nodes under any rigid plan, by one product.
//
// u = u_ref + A (q − q_ref), with twelve numbers of each segment: R − I row by row, then the shift
// of the segment's centre. So the case's own plan has the face that was solved for it, and the
// rounding of A, in half precision, counts only for what a plan differs from it.

/** The twelve numbers of each segment, one after the other. */
export function planNumbers(motions, centres) {
  const numbers = new Float64Array(12 * motions.length);
  motions.forEach((m, s) => {
    const c = centres[s];
    for (let r = 0; r < 3; r++) {
      let shift = m[4 * r + 3];
      for (let k = 0; k < 3; k++) {
        const entry = m[4 * r + k] - (r === k ? 1 : 0);
        numbers[12 * s + 3 * r + k] = entry;
        shift += entry * c[k];
      }
      numbers[12 * s + 9 + r] = shift;
    }
  });
  return numbers;
}

/**
 * Writes the displacements of all nodes, mm, into `out` (3 n).
 *
 * `columns` (3 a, width) belongs to the nodes `active` (a); the others do not move.
 */
export function displace(out, columns, active, reference, difference) {
  const width = difference.length;
  const numbers = Float32Array.from(difference);
  let at = 0;
  for (let i = 0; i < active.length; i++) {
    const node = 3 * active[i];
    for (let axis = 0; axis < 3; axis++) {
      let sum = reference[3 * i + axis];
      for (let k = 0; k < width; k++) sum += columns[at + k] * numbers[k];
      at += width;
      out[node + axis] = sum;
    }
  }
}

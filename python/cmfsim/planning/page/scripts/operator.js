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
  // Segments that stand where the reference has them add nothing.
  const moved = [];
  for (let s = 0; s < width; s += 12) {
    if (difference.subarray(s, s + 12).some((v) => v !== 0)) moved.push(s);
  }
  for (let i = 0; i < active.length; i++) {
    for (let axis = 0; axis < 3; axis++) {
      const row = width * (3 * i + axis);
      // Four sums, so that one need not wait for the other.
      let a = reference[3 * i + axis], b = 0, c = 0, d = 0;
      for (let m = 0; m < moved.length; m++) {
        const s = moved[m], at = row + s;
        for (let k = 0; k < 12; k += 4) {
          a += columns[at + k] * difference[s + k];
          b += columns[at + k + 1] * difference[s + k + 1];
          c += columns[at + k + 2] * difference[s + k + 2];
          d += columns[at + k + 3] * difference[s + k + 3];
        }
      }
      out[3 * active[i] + axis] = a + b + c + d;
    }
  }
}

// The plan operator: displacements of the skin's nodes under any rigid plan, by one product.
//
// u = u_ref + A (q − q_ref), with twelve numbers of each segment: R − I row by row, then the shift
// of the segment's centre. So the case's own plan has the face that was solved for it, and the
// rounding of A, in half precision, counts only for what a plan differs from it. Further columns are
// the shapes of a correction, with their amounts.

import { inverse, moved, product, rotationVector, DEGREE } from "./rigid.js";

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
  const counted = [];
  for (let s = 0; s < width; s += 4) {
    if (difference.subarray(s, s + 4).some((v) => v !== 0)) counted.push(s);
  }
  for (let i = 0; i < active.length; i++) {
    for (let axis = 0; axis < 3; axis++) {
      const row = width * (3 * i + axis);
      // Four sums, so that one need not wait for the other.
      let a = reference[3 * i + axis], b = 0, c = 0, d = 0;
      for (let m = 0; m < counted.length; m++) {
        const s = counted[m], at = row + s;
        a += columns[at] * difference[s];
        b += columns[at + 1] * difference[s + 1];
        c += columns[at + 2] * difference[s + 2];
        d += columns[at + 3] * difference[s + 3];
      }
      out[3 * active[i] + axis] = a + b + c + d;
    }
  }
}

/** How much of each shape a plan adds: as cmfsim.PlanCorrection, which explains the formula. */
export class Correction {
  /** values: of the page; reference: the motions of the case's own plan; plans, weights: arrays. */
  constructor({ length, segments, middles, arms }, reference, plans, weights) {
    this.length = length;
    this.segments = segments;
    this.middles = middles;
    this.arms = arms;
    this.backwards = segments.map((s) => inverse(reference[s]));
    this.plans = plans.values;
    this.weights = weights.values;
    [this.count, this.shapes] = weights.shape;
  }

  /** Six numbers of each segment, in multiples of the length: shift of its middle, turn times arm. */
  numbers(motions) {
    return this.segments.flatMap((s, i) => {
      const apart = product(this.backwards[i], motions[s]);
      const to = moved(apart, this.middles[i]);
      const turn = rotationVector(apart).map((v) => v * DEGREE * this.arms[i]);
      return [...to.map((v, k) => v - this.middles[i][k]), ...turn].map((v) => v / this.length);
    });
  }

  /** Writes the amounts under the motions into `out`. */
  amounts(out, motions) {
    const { plans, weights, shapes, length } = this;
    const here = this.numbers(motions);
    const width = here.length;
    out.fill(0);
    for (let n = 0; n < this.count; n++) {
      const all = [0, 0, 0];
      let near = 0;
      for (let s = 0; s < width; s += 6) {
        const own = [0, 0, 0];
        for (let k = s; k < s + 6; k++) {
          const there = plans[n * width + k] / length;
          own[0] += here[k] * there;
          own[1] += here[k] * here[k];
          own[2] += there * there;
        }
        near += covariance(own);
        own.forEach((v, i) => { all[i] += v; });
      }
      near += covariance(all);
      for (let m = 0; m < shapes; m++) out[m] += near * weights[n * shapes + m];
    }
  }
}

/** Matérn 5/2 of a squared distance, and the factor of its slope. */
function matern(square) {
  const root = Math.sqrt(5 * square), slope = (1 + root) * Math.exp(-root);
  return [slope + 5 / 3 * square * Math.exp(-root), slope];
}

/** Of two plans, from x·y, |x|² and |y|². */
function covariance([inner, one, other]) {
  const [mx, nx] = matern(one), [my, ny] = matern(other);
  return matern(Math.max(one + other - 2 * inner, 0))[0] - mx * my - 5 / 3 * inner * nx * ny;
}

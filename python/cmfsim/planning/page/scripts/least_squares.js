// Least squares with bounds by Levenberg-Marquardt steps: as cmfsim.face_planning searches.

import { factored, substituted } from "./cholesky.js";

// Central differences, mm and degrees; a step below STILL ends the search.
const DIFFERENCE = 1e-3;
const STILL = 1e-6;
const [FIRST_DAMPING, HARDER, SOFTER, MOST_DAMPING] = [1e-3, 10, 0.1, 1e12];

/** The x within low and high, from `start`, with the least sum of squares of `residuals`(x). */
export function boundedLeastSquares(residuals, start, low, high, steps) {
  const inside = (x) => x.map((v, i) => Math.min(high[i], Math.max(low[i], v)));
  let x = inside(start);
  let r = residuals(x);
  let damping = FIRST_DAMPING;
  for (let taken = 0; taken < steps; taken++) {
    const columns = derivatives(residuals, x);
    const gradient = columns.map((column) => inner(column, r));
    const free = x.map((_, i) => i).filter((i) => !(x[i] <= low[i] && gradient[i] > 0) && !(x[i] >= high[i] && gradient[i] < 0));
    if (!free.length) return x;
    const normal = free.map((i) => free.map((j) => inner(columns[i], columns[j])));
    const largest = Math.max(...normal.map((row, i) => row[i]), 1e-30);
    for (;;) {
      const damped = normal.map((row, i) => row.map((v, j) => (i === j ? v + damping * Math.max(v, 1e-12 * largest) : v)));
      const step = substituted(factored(damped), free.map((i) => -gradient[i]));
      const next = [...x];
      free.forEach((i, k) => { next[i] += step[k]; });
      const there = inside(next);
      if (Math.max(...there.map((v, i) => Math.abs(v - x[i]))) <= STILL || damping > MOST_DAMPING) return x;
      const reached = residuals(there);
      if (inner(reached, reached) < inner(r, r)) {
        [x, r] = [there, reached];
        damping *= SOFTER;
        break;
      }
      damping *= HARDER;
    }
  }
  return x;
}

function derivatives(residuals, x) {
  return x.map((_, i) => {
    const at = (step) => residuals(x.map((v, k) => (k === i ? v + step : v)));
    const [ahead, behind] = [at(DIFFERENCE), at(-DIFFERENCE)];
    return ahead.map((v, k) => (v - behind[k]) / (2 * DIFFERENCE));
  });
}

const inner = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);

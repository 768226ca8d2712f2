// How far to trust the face: half the width of a band along the normal of the skin, under any plan.

import { DEGREE, inverse, moved, product, rotationVector } from "./rigid.js";

/** As cmfsim.PlanBand, which explains the formula. */
export class Band {
  /** values: of the page; reference: motions of the case's own plan; centres of its segments. */
  constructor({ state, coverage, regions, note }, arrays, reference, centres) {
    Object.assign(this, { state, coverage, note });
    this.regions = regions.map((region, i) => ({ ...region, nodes: arrays[`band_region_${i}`].values }));
    this.still = arrays.band_still.values;
    this.shift = arrays.band_shift.values;
    this.rates = arrays.band_rates.values;
    this.factor = arrays.band_factor.values;
    this.moduli = arrays.band_shift.shape[0];
    this.backwards = reference.map(inverse);
    this.places = reference.map((m, s) => moved(m, centres[s]));
    this.sd = new Float32Array(this.still.length);
  }

  /** Six numbers of each segment: further shift of its centre, mm, and further turn, radians. */
  numbers(motions) {
    return motions.flatMap((m, s) => {
      const further = product(m, this.backwards[s]);
      const to = moved(further, this.places[s]);
      return [...to.map((v, k) => v - this.places[s][k]), ...rotationVector(further).map((v) => v * DEGREE)];
    });
  }

  /** The standard deviation at each node of the skin, mm; kept until the next plan. */
  deviations(motions) {
    const numbers = this.numbers(motions);
    const { still, shift, rates, moduli, sd } = this;
    const count = still.length, width = numbers.length;
    for (let i = 0; i < count; i++) {
      let sum = still[i];
      for (let p = 0; p < moduli; p++) {
        let moves = shift[p * count + i];
        const row = (p * count + i) * width;
        for (let q = 0; q < width; q++) moves += rates[row + q] * numbers[q];
        sum += moves * moves;
      }
      sd[i] = Math.sqrt(sum);
    }
    return sd;
  }

  /** The mean half-width in each region, mm. */
  widths(motions) {
    const sd = this.deviations(motions);
    return this.regions.map(({ nodes, factor }) => factor * nodes.reduce((sum, i) => sum + sd[i], 0) / nodes.length);
  }

  /** The half-width at each node, mm; 0 outside of the face, where none is stated. */
  halfWidths(motions) {
    return this.deviations(motions).map((v, i) => v * this.factor[i]);
  }
}

// How the sites follow those that are placed: the conditional mean of normally distributed errors.

import { factored, substituted } from "./cholesky.js";

export class SiteModel {
  /** means: 3 numbers for each site, mm; covariance of their errors, rows of mm²; std of a placed site. */
  constructor(means, covariance, placedStd) {
    this.means = means;
    this.size = means.length;
    this.covariance = covariance;
    this.noise = placedStd ** 2;
    this.known = null;
  }

  /** What depends only on which sites are placed: the factor, and the errors of all sites, mm. */
  given(sites) {
    const key = sites.join();
    if (this.known?.key === key) return this.known;
    const rows = sites.flatMap((s) => [3 * s, 3 * s + 1, 3 * s + 2]);
    const at = (i, j) => this.covariance[i * this.size + j];
    const factor = factored(rows.map((i) => rows.map((j) => at(i, j) + (i === j ? this.noise : 0))));
    const errors = new Array(this.size / 3).fill(0);
    const weights = [];
    for (let i = 0; i < this.size; i++) {
      const column = rows.map((j) => at(i, j));
      weights.push(column.length ? substituted(factor, column) : []);
      const explained = weights[i].reduce((sum, v, k) => sum + v * column[k], 0);
      errors[Math.floor(i / 3)] += Math.max(0, at(i, i) - explained);
    }
    this.known = { key, rows, factor, weights, errors: errors.map(Math.sqrt) };
    return this.known;
  }

  /** Of some sites the one that, placed next, takes most from the variance of all; undefined of none. */
  mostUseful(sites, candidates) {
    const { rows, weights } = this.given(sites);
    const left = (i, j) => weights[j].reduce((v, w, k) => v - w * this.covariance[i * this.size + rows[k]], this.covariance[i * this.size + j]);
    const gains = candidates.map((site) => {
      let gain = 0;
      for (let i = 3 * site; i < 3 * site + 3; i++) {
        const own = left(i, i) + this.noise;
        for (let j = 0; j < this.size; j++) gain += left(j, i) ** 2 / own;
      }
      return gain;
    });
    return candidates[gains.indexOf(Math.max(...gains))];
  }

  /** The sites' shifts, mm, three for each, where those at `sites` are at `points`. */
  shifts(sites, points) {
    const out = new Float64Array(this.size);
    if (!sites.length) return out;
    const { rows, factor } = this.given(sites);
    const away = points.flat().map((v, k) => v - this.means[rows[k]]);
    const weights = substituted(factor, away);
    for (let i = 0; i < this.size; i++) {
      let sum = 0;
      for (let k = 0; k < rows.length; k++) sum += this.covariance[i * this.size + rows[k]] * weights[k];
      out[i] = sum;
    }
    return out;
  }
}

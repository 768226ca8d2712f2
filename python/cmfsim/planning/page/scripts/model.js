// The patient of the page: bones, skin and sites under any plan; no document, no drawing.

import { _ } from "./elements.js";
import { Band } from "./band.js";
import { Carrier } from "./carrier.js";
import { measure } from "./measures.js";
import { Correction, displace, planNumbers } from "./operator.js";
import { moved } from "./rigid.js";

// Points of the profile further apart than this, mm, before, have skin between them that is left out.
const GAP = 15;
// Share of the plans that the usual error is not exceeded at.
const USUAL = 0.9;

export class PatientFace {
  /** page: the values of the page; arrays: its unpacked numbers. */
  constructor(page, arrays) {
    this.page = page;
    const take = (name) => arrays[name].values;
    this.centres = page.segments.map((s) => s.centre);
    this.reference = page.segments.map((s) => s.reference);
    this.columns = take("columns");
    this.active = take("active");
    this.referenceShift = take("reference_shift");
    this.numbersOfReference = planNumbers(this.reference, this.centres);
    this.correction = page.correction &&
      new Correction(page.correction, this.reference, arrays.correction_plans, arrays.correction_weights);
    this.band = page.band && new Band(page.band, arrays, this.reference, this.centres);
    this.before = take("face");
    this.triangles = take("face_triangles");
    const carried = (part) => ({
      triangle: take(`${part}_triangle`), barycentric: take(`${part}_barycentric`),
      offset: take(`${part}_offset`), share: take(`${part}_share`),
    });
    this.shift = new Float32Array(take("nodes").length);
    this.face = new Carrier(take("nodes"), take("skin_triangles"), carried("face"));
    this.sites = new Carrier(take("nodes"), take("skin_triangles"), carried("site"));
    this.siteBefore = take("sites");
    this.profileEnds = take("profile_ends");
    this.profileShare = take("profile_share");
    this.tooth = page.occlusion && { points: take("occlusion_points"), depth: take("occlusion_depth") };
  }

  /** Writes the displacements of the face's vertices under the motions, mm, into `out`. */
  faceShift(out, motions) {
    this.skinShift(motions);
    this.face.carry(out, this.shift);
  }

  /** The displacements of the nodes of the skin, kept until the next plan; exact where known. */
  skinShift(motions) {
    if (this.last && sameMotions(this.last, motions)) return this.shift;
    this.last = motions.map((m) => [...m]);
    if (this.isExact(motions)) {
      this.shift.set(this.exact.shift);
      return this.shift;
    }
    // Nodes that the operator leaves out do not move; an exact solution may have moved them.
    if (this.exact) this.shift.fill(0);
    displace(this.shift, this.columns, this.active, this.referenceShift, this.operatorNumbers(motions));
    return this.shift;
  }

  /** What the operator's columns are multiplied by: numbers less the reference's, then amounts. */
  operatorNumbers(motions) {
    const numbers = planNumbers(motions, this.centres);
    const { correction, numbersOfReference } = this;
    const all = new Float64Array(numbers.length + (correction ? correction.shapes : 0));
    for (let i = 0; i < numbers.length; i++) all[i] = numbers[i] - numbersOfReference[i];
    correction?.amounts(all.subarray(numbers.length), motions);
    return all;
  }

  /** Takes an exact solution: the displacements of all nodes under the motions, mm. */
  takeExact(motions, shift, figures) {
    if (shift.length !== this.shift.length || !shift.every(Number.isFinite)) {
      throw new Error(_`the solution does not belong to this page`);
    }
    this.exact = { motions, shift, figures };
    this.last = null;
  }

  isExact(motions) {
    return Boolean(this.exact) && sameMotions(this.exact.motions, motions);
  }

  isReference(motions) {
    return sameMotions(this.reference, motions);
  }

  /** The places of all sites under the motions, or before them where none are given. */
  sitePlaces(motions = null) {
    const places = {};
    const skin = new Float64Array(this.siteBefore.length);
    if (motions) {
      this.skinShift(motions);
      this.sites.carry(skin, this.shift);
    }
    this.page.skin_sites.forEach(({ name }, i) => {
      places[name] = [0, 1, 2].map((k) => this.siteBefore[3 * i + k] + skin[3 * i + k]);
    });
    for (const { name, place, segment } of this.page.bone_sites) {
      places[name] = motions && segment !== null ? moved(motions[segment], place) : place;
    }
    return places;
  }

  /** The value of each measure under the motions, or before them. */
  measures(motions = null) {
    return measure(this.page.measures, this.sitePlaces(motions), motions);
  }

  /** The midline profile of face places: rows of y, z, and whether joined to the row before. */
  profile(places) {
    const { profileEnds: ends, profileShare: share } = this;
    const at = (i, axis) => {
      const [a, b] = [3 * ends[2 * i] + axis, 3 * ends[2 * i + 1] + axis];
      return places[a] + share[i] * (places[b] - places[a]);
    };
    const rows = Array.from(share, (_, i) => [at(i, 1), at(i, 2)]);
    // Where the profile was cut off it is not joined.
    this.joined ??= rows.map((row, i) => i > 0 && Math.hypot(row[0] - rows[i - 1][0], row[1] - rows[i - 1][1]) < GAP);
    return rows.map((row, i) => [...row, this.joined[i]]);
  }

  /** How far a plan is from the case's own, mm: at the corners of the boxes around segments. */
  distance(motions) {
    let worst = 0;
    this.page.segments.forEach(({ box }, s) => {
      for (let corner = 0; corner < 8; corner++) {
        const point = [0, 1, 2].map((k) => box[(corner >> k) & 1][k]);
        const [a, b] = [moved(motions[s], point), moved(this.reference[s], point)];
        worst = Math.max(worst, Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]));
      }
    });
    return worst;
  }

  /** Errors to expect of the operator, mm: mean, largest at nine of ten plans and at the worst; null beyond what was tried. */
  expectedError(motions) {
    const { is_exact: isExact, reach_mm: reach, trials, left_out: leftOut } = this.page.expected_error;
    if (isExact) return { mean: 0, usual: 0, largest: 0 };
    const distance = this.distance(motions);
    if (distance > reach) return null;
    const solved = [...trials.filter((t) => !t.failed), ...leftOut];
    const ratios = (key) => solved.map((t) => t[key] / t.distance_mm).sort((a, b) => a - b);
    const [means, largest] = [ratios("mean_mm"), ratios("largest_mm")];
    const at = (values, share) => distance * quantile(values, share);
    return { mean: at(means, 1), usual: at(largest, USUAL), largest: at(largest, 1) };
  }

  /** How deep the lower teeth reach into the upper ones, mm; 0 where they do not. */
  toothDepth(motions) {
    const { upper, lower, origin, spacing, shape } = this.page.occlusion;
    const up = upper === null ? null : motions?.[upper];
    const low = lower === null ? null : motions?.[lower];
    const { points, depth } = this.tooth;
    let worst = 0;
    for (let i = 0; i < points.length; i += 3) {
      let p = [points[i], points[i + 1], points[i + 2]];
      if (low) p = moved(low, p);
      if (up) p = backwards(up, p);
      worst = Math.max(worst, sampled(depth, shape, p.map((v, k) => (v - origin[k]) / spacing)));
    }
    return worst;
  }
}

/** The value of a sorted list at a share of its length, between its values as numpy.percentile. */
function quantile(values, share) {
  if (!values.length) return 0;
  const place = share * (values.length - 1);
  const low = Math.floor(place);
  const high = Math.min(low + 1, values.length - 1);
  return values[low] + (place - low) * (values[high] - values[low]);
}

const sameMotions = (a, b) => a === b || a.every((m, s) => m.every((v, i) => v === b[s][i]));

/** The point that a rigid motion takes to `p`. */
function backwards(m, p) {
  const d = [p[0] - m[3], p[1] - m[7], p[2] - m[11]];
  return [0, 1, 2].map((c) => m[c] * d[0] + m[4 + c] * d[1] + m[8 + c] * d[2]);
}

/** The trilinear value of a grid at a place in voxels; 0 outside of it. */
function sampled(values, [nx, ny, nz], [x, y, z]) {
  const [i, j, k] = [Math.floor(x), Math.floor(y), Math.floor(z)];
  if (i < 0 || j < 0 || k < 0 || i >= nx - 1 || j >= ny - 1 || k >= nz - 1) return 0;
  let sum = 0;
  for (let corner = 0; corner < 8; corner++) {
    const [a, b, c] = [corner & 1, (corner >> 1) & 1, (corner >> 2) & 1];
    const weight = (a ? x - i : 1 - x + i) * (b ? y - j : 1 - y + j) * (c ? z - k : 1 - z + k);
    sum += weight * values[((i + a) * ny + j + b) * nz + k + c];
  }
  return sum;
}

// A point of the skin is pulled to a place, and bones follow: the plan nearest to the one before.
//
// Minimised is |place(x) − goal|² / σ² + Σ ((x − x₀) / p)², x the numbers of the segments that follow
// and x₀ those before the pull: cmfsim.plan_for_face with one point as its target, but for x₀, which
// is no movement there.

import { Carrier } from "./carrier.js";
import { NUMBERS, clinicalNumbers, motionFromNumbers } from "./clinical.js";
import { boundedLeastSquares } from "./least_squares.js";
import { displace } from "./operator.js";
import { LIMITS } from "./plans.js";

// σ, mm, and p, mm and degrees: those of PointTarget and FaceSearch.
const POINT_STD = 0.5;
const PRIOR_STD = 20;
const MOST_TRIED = 25;
// A point that 1 mm or 1° of no segment moves by this, mm, cannot be pulled.
const LEAST_PULL = 0.01;

/** One point of a carrier (the face's or the sites'), under any motions, at the cost of the point. */
export class PulledPoint {
  /** face: PatientFace; carrier: one of its carriers; index: the point's number; before: its place. */
  constructor(face, carrier, index, before) {
    this.face = face;
    this.before = [...before];
    const { nodes, triangles, points } = carrier;
    const corners = [...triangles.slice(3 * points.triangle[index], 3 * points.triangle[index] + 3)];
    const three = (values, i) => values.slice(3 * i, 3 * i + 3);
    this.carrier = new Carrier(Float64Array.from(corners.flatMap((c) => [...three(nodes, c)])), Uint32Array.of(0, 1, 2), {
      triangle: Uint32Array.of(0), barycentric: three(points.barycentric, index),
      offset: three(points.offset, index), share: points.share.slice(index, index + 1),
    });
    // The operator's rows of the corners that move.
    const width = face.columns.length / face.referenceShift.length;
    this.active = [];
    const [columns, reference] = [[], []];
    corners.forEach((corner, i) => {
      const at = face.active.indexOf(corner);
      if (at < 0) return;
      this.active.push(i);
      columns.push(...face.columns.subarray(3 * width * at, 3 * width * (at + 1)));
      reference.push(...face.referenceShift.subarray(3 * at, 3 * at + 3));
    });
    this.columns = Float64Array.from(columns);
    this.reference = reference;
    this.shift = new Float64Array(9);
    this.out = new Float64Array(3);
  }

  /** Where the point is under the motions, mm. */
  place(motions) {
    displace(this.shift, this.columns, this.active, this.reference, this.face.operatorNumbers(motions));
    this.carrier.carry(this.out, this.shift);
    return this.before.map((v, k) => v + this.out[k]);
  }
}

/** The pull of a point from motions: those of `following` segments change, all others stay. */
export class Pull {
  constructor(point, segments, motions, following) {
    this.point = point;
    this.start = motions.map((m) => [...m]);
    this.following = following;
    this.places = following.map((s) => segments[s].points[0].place);
    this.x0 = following.flatMap((s, i) => {
      const numbers = clinicalNumbers(motions[s], this.places[i]);
      return NUMBERS.map(({ key }) => numbers[key]);
    });
    this.x = this.x0;
    this.limit = this.x0.map((v, i) => Math.max(LIMITS[NUMBERS[i % 6].unit], Math.abs(v)));
    this.from = point.place(motions);
  }

  motions(x) {
    const found = [...this.start];
    this.following.forEach((s, i) => {
      const numbers = Object.fromEntries(NUMBERS.map(({ key }, k) => [key, x[6 * i + k]]));
      found[s] = motionFromNumbers(numbers, this.places[i]);
    });
    return found;
  }

  /** Whether any number of the following segments moves the point at all. */
  get moves() {
    return this.x0.some((_, i) => {
      const there = this.point.place(this.motions(this.x0.map((v, k) => (k === i ? v + 1 : v))));
      return Math.hypot(...there.map((v, k) => v - this.from[k])) > LEAST_PULL;
    });
  }

  /** The motions with which the point comes nearest to `goal`, mm; begins where the last pull ended. */
  towards(goal) {
    const residuals = (x) => [
      ...this.point.place(this.motions(x)).map((v, k) => (v - goal[k]) / POINT_STD),
      ...x.map((v, i) => (v - this.x0[i]) / PRIOR_STD),
    ];
    this.x = boundedLeastSquares(residuals, this.x, this.limit.map((v) => -v), this.limit, MOST_TRIED);
    return this.motions(this.x);
  }
}

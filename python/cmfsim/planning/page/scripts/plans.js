// The variants of a plan, with undo and redo.

import { _ } from "./elements.js";
import { clinicalNumbers } from "./clinical.js";
import { History } from "./history.js";

// Beyond these, mm and degrees, a number is a slip, not a plan.
export const LIMITS = { mm: 30, "°": 30 };
const LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ";

export class Plans extends History {
  /** reference: the motions of the case's own plan, in the order of the segments; more variants. */
  constructor(reference, more = []) {
    const own = reference.map((m) => [...m]);
    super({ active: 0, variants: [{ name: "A", motions: own }, ...more] });
    this.reference = own;
  }

  get active() {
    return this.now.variants[this.now.active];
  }

  /** The state in which the active variant has other motions. */
  withMotions(motions) {
    const variants = this.now.variants.map((v, i) =>
      i === this.now.active ? { ...v, motions } : v,
    );
    return { ...this.now, variants };
  }

  choose(index) {
    this.now = { ...this.now, active: index };
  }

  /** Adds a variant with these motions and makes it the active one. */
  add(motions, name = this.freeName()) {
    const variants = [...this.now.variants, { name, motions: motions.map((m) => [...m]) }];
    this.take({ active: variants.length - 1, variants });
  }

  rename(name) {
    const variants = this.now.variants.map((v, i) => (i === this.now.active ? { ...v, name } : v));
    this.take({ ...this.now, variants });
  }

  remove() {
    if (this.now.variants.length < 2) return;
    const variants = this.now.variants.filter((_, i) => i !== this.now.active);
    this.take({ active: Math.max(0, this.now.active - 1), variants });
  }

  freeName() {
    const used = new Set(this.now.variants.map((v) => v.name));
    const letter = [...LETTERS].find((l) => !used.has(l));
    return letter ?? _`Variant ${this.now.variants.length + 1}`;
  }
}

/** What of a motion leaves the limits, in words; empty where nothing does. `was` may be beyond. */
export function beyondLimits(motion, was, point, numbers) {
  const values = clinicalNumbers(motion, point);
  const earlier = clinicalNumbers(was, point);
  for (const { key, label, unit } of numbers) {
    if (!Number.isFinite(values[key])) return _`${label} is not a number`;
    const most = Math.max(LIMITS[unit], Math.abs(earlier[key])) + 1e-6;
    if (Math.abs(values[key]) > most) {
      return _`${label} would be ${values[key].toFixed(1)} ${unit}: at most ${LIMITS[unit]} ${unit} are allowed`;
    }
  }
  return "";
}

// The controls of one segment: where it is measured, about what it turns, and its six numbers.

import { NUMBERS, clinicalNumbers, withNumber } from "./clinical.js";
import { _, button, element, numberField, signed, table, typedNumber } from "./elements.js";
import { LIMITS, beyondLimits } from "./plans.js";
import { STAYS, moved, product } from "./rigid.js";

const STEP = 0.1;
// How far sliders reach, mm or degrees; what is further is typed.
const SLIDER = 15;

export class PlanPanel {
  /** app gives: page, plans, preview(motion), commit(), report(text), changed(). */
  constructor(app) {
    this.app = app;
    this.segment = Math.max(0, app.page.segments.findIndex((s) => s.reference.join() !== STAYS.join()));
    this.point = app.page.segments.map(() => 0);
    this.centre = app.page.segments.map(() => 0);
    this.fields = {};
    this.root = element("div");
    this.build();
  }

  get motion() { return this.app.motions[this.segment]; }
  get points() { return this.app.page.segments[this.segment].points; }
  get place() { return this.points[this.point[this.segment]].place; }
  get turnsAbout() { return this.points[this.centre[this.segment]].place; }

  build() {
    const { page } = this.app;
    this.tabs = page.segments.map((s, i) =>
      button(s.label, () => this.choose(i), { role: "tab" }));
    this.measured = element("select", { id: "measured-at", onchange: (e) => { this.point[this.segment] = Number(e.target.value); this.app.changed(); } });
    this.about = element("select", { id: "turns-about", onchange: (e) => { this.centre[this.segment] = Number(e.target.value); this.app.changed(); } });
    const rows = NUMBERS.flatMap((entry) => this.row(entry));
    this.table = element("div");
    this.root.append(
      element("h2", { textContent: _`Plan` }),
      element("div", { className: "row", role: "tablist", "aria-label": _`Segment` }, ...this.tabs),
      element("div", { className: "row" }, element("label", { for: "measured-at", textContent: _`Measured at` }), this.measured),
      element("div", { className: "row" }, element("label", { for: "turns-about", textContent: _`Turns about` }), this.about),
      element("div", { className: "numbers" }, ...rows),
      element("div", { className: "row" },
        this.undo = button(_`Undo`, () => this.app.undo(), { title: _`Ctrl+Z` }),
        this.redo = button(_`Redo`, () => this.app.redo(), { title: _`Ctrl+Y` }),
        button(_`Reset segment to the case's plan`, () => this.set(page.segments[this.segment].reference)),
        button(_`No movement`, () => this.set(STAYS))),
      this.bite = element("p", { className: "state", id: "target-bite", role: "status" }),
      ...((page.target_bite?.lower ?? null) === null ? []
        : [button(_`Move the lower jaw into the target bite`, () => this.intoBite(), { id: "into-bite" })]),
      this.table,
    );
    this.fill();
  }

  /** The motion of the lower jaw that brings it into the bite of the scans, by that of the upper one. */
  get intoTarget() {
    const { upper, motion } = this.app.page.target_bite;
    return product(upper === null ? STAYS : this.app.motions[upper], motion);
  }

  intoBite() {
    const { lower } = this.app.page.target_bite;
    const motion = this.intoTarget;
    const why = beyondLimits(motion, this.app.plans.active.motions[lower], this.app.page.segments[lower].points[0].place, NUMBERS);
    if (why) {
      this.app.report(_`${why}. The plan was not changed.`);
      return;
    }
    this.app.preview({ segment: lower, motion });
    this.app.commit();
  }

  showBite() {
    const { target_bite: bite } = this.app.page;
    this.bite.hidden = !bite;
    if (!bite) return;
    const now = bite.lower === null ? STAYS : this.app.motions[bite.lower];
    const there = this.intoTarget;
    const off = Math.max(...bite.places.map((p) => Math.hypot(...moved(there, p).map((v, i) => v - moved(now, p)[i]))));
    this.bite.textContent = _`The lower teeth are ${off.toFixed(1)} mm off the target bite of the scans.`;
  }

  row({ key, label, unit, low, high }) {
    const limit = LIMITS[unit];
    const id = `number-${key}`;
    const field = numberField({
      id, title: _`${-limit} to ${limit} ${unit}; the arrow keys change it by ${STEP}`,
      onkeydown: (e) => this.stepped(key, e),
      oninput: () => { this.typing = key; },
      onchange: (e) => this.typed(key, e.target),
      onblur: () => { this.typing = null; },
    });
    const slider = element("input", {
      type: "range", step: STEP, min: -SLIDER, max: SLIDER, "aria-label": `${label}, ${unit}`,
      oninput: (e) => this.change(key, Number(e.target.value), false),
      onchange: (e) => this.change(key, Number(e.target.value), true),
    });
    this.fields[key] = { field, slider };
    return [element("label", { for: id, textContent: `${label}, ${unit}` }), field, slider,
      element("div", { className: "sense" }, element("span", { textContent: low }), element("span", { textContent: high }))];
  }

  choose(index) {
    this.segment = index;
    this.fill();
    this.app.changed();
  }

  /** The choices of the segment that is shown now. */
  fill() {
    const choices = (select, chosen) => {
      select.replaceChildren(...this.points.map((p, i) => element("option", { value: String(i), textContent: p.label })));
      select.value = String(chosen);
    };
    choices(this.measured, this.point[this.segment]);
    choices(this.about, this.centre[this.segment]);
    this.tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(i === this.segment));
      tab.tabIndex = i === this.segment ? 0 : -1;
      tab.onkeydown = (e) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
        if (!step) return;
        const next = (i + step + this.tabs.length) % this.tabs.length;
        this.choose(next);
        this.tabs[next].focus();
        e.preventDefault();
      };
    });
  }

  typed(key, input) {
    this.typing = null;
    const value = typedNumber(input.value);
    if (!Number.isFinite(value)) {
      this.app.report(_`Type a number, such as 2.5 or 2,5; the plan was not changed.`);
      this.app.changed();
      return;
    }
    this.change(key, value, true);
  }

  /** Changes a number by the arrow keys. */
  stepped(key, event) {
    const step = { ArrowUp: STEP, ArrowDown: -STEP }[event.key];
    if (!step) return;
    event.preventDefault();
    const value = typedNumber(event.target.value);
    if (!Number.isFinite(value)) return;
    this.typing = null;
    this.change(key, Math.round((value + step) * 100) / 100, true);
  }

  /** Sets one number; a change that is not kept yet is a preview. */
  change(key, value, keep) {
    const was = this.app.plans.active.motions[this.segment];
    const motion = withNumber(was, this.place, this.turnsAbout, key, value);
    const why = beyondLimits(motion, was, this.place, NUMBERS);
    if (why) {
      this.app.report(`${why}. ${keep ? _`The plan was not changed.` : ""}`);
      // A field must not show what the plan does not have.
      if (keep) this.app.changed();
      return;
    }
    this.app.preview({ segment: this.segment, motion });
    if (keep) this.app.commit();
  }

  set(motion) {
    this.app.preview({ segment: this.segment, motion: [...motion] });
    this.app.commit();
  }

  show() {
    const numbers = clinicalNumbers(this.motion, this.place);
    for (const { key } of NUMBERS) {
      const { field, slider } = this.fields[key];
      const text = (numbers[key] + 0).toFixed(2).replace(/^-(0\.0+)$/, "$1");
      // What is being typed is left alone, until it is a number or is given up.
      if (this.typing !== key) field.value = text;
      slider.value = String(numbers[key]);
      slider.setAttribute("aria-valuetext", text);
    }
    this.showBite();
    this.undo.disabled = !this.app.plans.past.length;
    this.redo.disabled = !this.app.plans.future.length;
    const rows = this.points.map(({ label, place }) => {
      const to = moved(this.motion, place);
      return [label, signed(-(to[1] - place[1])), signed(to[2] - place[2]), signed(to[0] - place[0])];
    });
    this.table.replaceChildren(table(
      _`${this.app.page.segments[this.segment].label}: movement at each point, mm`,
      ["", "forwards", "up", "left"], rows));
  }
}

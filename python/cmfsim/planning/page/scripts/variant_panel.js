// Named variants of the plan, and what differs between them.

import { NUMBERS, clinicalNumbers } from "./clinical.js";
import { _, button, element, shown, signed, table } from "./elements.js";
import { STAYS } from "./rigid.js";

const MOST_NAME = 40;

export class VariantPanel {
  constructor(app) {
    this.app = app;
    this.tabs = element("div", { className: "row", role: "group", "aria-label": _`Variants` });
    this.name = element("input", {
      type: "text", id: "variant-name", maxLength: MOST_NAME,
      onchange: (e) => this.rename(e.target.value.trim()),
    });
    this.differences = element("div", { id: "differences" });
    this.root = element("div", {},
      element("h2", { textContent: _`Variants` }), this.tabs,
      element("div", { className: "row" },
        element("label", { for: "variant-name", textContent: _`Name` }), this.name,
        button(_`Copy to a new variant`, () => this.add(app.plans.active.motions)),
        button(_`New from the case's plan`, () => this.add(app.plans.reference)),
        button(_`New without movement`, () => this.add(app.plans.reference.map(() => STAYS))),
        this.removal = button(_`Remove`, () => { app.plans.remove(); app.changed(); }),
        button(_`Reset all`, () => app.reset(), { title: _`Keep only the case's plan; undo restores the variants` })),
      this.differences);
  }

  add(motions) {
    this.app.plans.add(motions);
    this.app.changed();
  }

  rename(name) {
    const taken = this.app.plans.now.variants.some((v, i) => v.name === name && i !== this.app.plans.now.active);
    if (!name || taken) this.app.report(name ? _`Another variant is called ${name}.` : _`A variant needs a name.`);
    else this.app.plans.rename(name);
    this.app.changed();
  }

  show() {
    const { plans } = this.app;
    const { variants, active } = plans.now;
    this.tabs.replaceChildren(...variants.map((v, i) =>
      button(v.name, () => { plans.choose(i); this.app.changed(); }, { "aria-pressed": String(i === active) })));
    if (document.activeElement !== this.name) this.name.value = plans.active.name;
    this.removal.disabled = variants.length < 2;
    this.differences.replaceChildren(...(variants.length > 1 ? [this.table()] : []));
  }

  /** Motions where segments are measured, and measures, side by side. */
  table() {
    const { page, plans, face } = this.app;
    const { variants } = plans.now;
    const rows = [];
    page.segments.forEach((segment, s) => {
      const place = segment.points[0].place;
      const values = variants.map((v) => clinicalNumbers(v.motions[s], place));
      for (const { key, label, unit } of NUMBERS) {
        const numbers = values.map((v) => v[key]);
        if (numbers.some((n) => Math.abs(n) >= 0.05)) {
          rows.push([`${segment.label}: ${label.toLowerCase()}, ${unit}`, ...numbers.map((n) => signed(n)), spread(numbers)]);
        }
      }
    });
    const measured = variants.map((v) => face.measures(v.motions));
    page.measures.forEach(({ label, unit }, i) => {
      if (measured[0][i] === null) return;
      const numbers = measured.map((m) => m[i]);
      rows.push([`${label}, ${unit}`, ...numbers.map((n) => shown(n)), spread(numbers)]);
    });
    return table(_`Movement of each segment at its first point, and measures of the face`, ["", ...variants.map((v) => v.name), _`differ by`], rows);
  }
}

const spread = (numbers) => (Math.max(...numbers) - Math.min(...numbers)).toFixed(1);

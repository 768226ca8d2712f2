// The measures of face and occlusion before, under the case's plan, and under the variant that is shown.

import { _, element, shown, signed } from "./elements.js";

export class MeasurePanel {
  constructor(app) {
    this.app = app;
    this.body = element("tbody");
    const heads = ["", "before", "case's plan", "now", "change"];
    this.root = element("div", {},
      element("h2", { textContent: _`Measures of face and occlusion` }),
      element("div", { className: "wide" }, element("table", { id: "measures" },
        element("caption", { textContent: _`Change: now minus before; mm and degrees.` }),
        element("thead", {}, element("tr", {}, ...heads.map((h) => element("th", { scope: "col", textContent: h })))),
        this.body)),
      ...app.page.measure_notes.map((text) => element("p", { className: "note", textContent: text })));
  }

  show() {
    const { page, face, motions } = this.app;
    this.before ??= face.measures();
    this.ofCase ??= face.measures(face.reference);
    const now = face.measures(motions);
    this.body.replaceChildren(...page.measures.map(({ label, unit, absent, about }, i) => {
      const head = element("th", { scope: "row", textContent: `${label},\u00a0${unit}`, title: about });
      if (now[i] === null) {
        return element("tr", {}, head, element("td", { className: "absent", colspan: "4", textContent: absent }));
      }
      const cells = [shown(this.before[i]), shown(this.ofCase[i]), shown(now[i]), signed(now[i] - this.before[i])];
      return element("tr", {}, head, ...cells.map((c) => element("td", { textContent: c })));
    }));
  }
}

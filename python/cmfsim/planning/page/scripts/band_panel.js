// How far to trust the face under the plan that is shown, by region.

import { _, element } from "./elements.js";

export class BandPanel {
  constructor(app) {
    this.app = app;
    const { band } = app.face;
    this.root = element("div", {});
    if (!band) return;
    this.body = element("tbody");
    const percent = Math.round(100 * band.coverage);
    const cases = band.regions[0]?.cases;
    const meaning = band.state === "calibrated"
      ? _`In ${percent} % of cases like the ${cases} of the calibration, all of a region is within this distance, along the skin's normal.`
      : _`Uncalibrated: a multiple of the standard deviation that follows from assumptions about tissue and surgery. No case with a known outcome shows that it covers ${percent} %.`;
    this.root.append(
      element("h2", { textContent: _`How far to trust it (${band.state})` }),
      element("table", { id: "band" },
        element("thead", {}, element("tr", {}, ...["", "± mm"].map((h) => element("th", { scope: "col", textContent: h })))),
        this.body),
      element("p", { className: "note", textContent: band.note ? _`${meaning} Calibrated on: ${band.note}.` : meaning }));
  }

  show() {
    const { band } = this.app.face;
    if (!band) return;
    const widths = band.widths(this.app.motions);
    this.body.replaceChildren(...band.regions.map(({ name }, i) => element("tr", {},
      element("th", { scope: "row", textContent: name }),
      element("td", { textContent: widths[i].toFixed(1) }))));
  }
}

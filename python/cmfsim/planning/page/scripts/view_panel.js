// How the picture shows the face: standard views, opacity, before and after, side by side, colours.

import { VIEWS } from "./camera.js";
import { MAP_COLOURS } from "./colours.js";
import { _, button, element } from "./elements.js";

/** Turns the camera to a standard view by its number. */
export function look(app, index) {
  app.camera.look(VIEWS[index]);
  app.redraw();
}

/** Buttons of the standard views, the last of which shows the whole. */
export function addViews(app, whole) {
  document.getElementById("views").append(
    ...VIEWS.map((view, i) => button(view.name, () => look(app, i), { title: _`key ${i + 1}` })),
    button(whole, () => { app.camera.recentre(); app.redraw(); }, { title: _`key 0` }));
}

/** A slider from 0 to 1 with its label. */
export const slider = (id, label, value, onchange) => element("label", {}, label, element("input", {
  type: "range", min: 0, max: 1, step: 0.01, value, id, oninput: (e) => onchange(Number(e.target.value)),
}));

/** What can be switched on, by key. */
const BOXES = { side: _`Side by side`, map: _`Colour by movement`, band: _`Colour by uncertainty`, handles: _`Handles`, pull: _`Pull the skin` };

// Opacity of skin through which bones are seen.
const SEEN_THROUGH = 0.55;

export class ViewPanel {
  /** boxes: the keys of what this page can show. */
  constructor(app, boxes) {
    this.app = app;
    // Where bones are planned they are seen at once.
    const skin = boxes.includes("handles") ? SEEN_THROUGH : 1;
    this.values = { skin, bones: 1, share: 1, side: false, map: false, band: false, handles: true, pull: false };
    addViews(app, _`Whole face`);
    const share = (key, label) => slider(`show-${key}`, label, this.values[key], (value) => this.set(key, value));
    const box = (key) => element("label", {}, element("input", {
      type: "checkbox", checked: this.values[key], id: `show-${key}`,
      onchange: (e) => this.set(key, e.target.checked),
    }), BOXES[key]);
    document.getElementById("controls").append(
      share("share", "Before – after"), share("skin", "Skin"), share("bones", "Bones"), ...boxes.map(box));
    this.legend = document.getElementById("legend");
  }

  set(key, value) {
    this.values[key] = value;
    // One field has the colours.
    const other = { map: "band", band: "map" }[key];
    const shown = document.getElementById(`show-${other}`);
    if (value && shown) this.values[other] = shown.checked = false;
    this.app.reshow();
  }

  /** The legend of the colours: 0 to `most` mm. */
  showLegend(most) {
    const { map, band } = this.values;
    this.legend.hidden = !(map || band);
    if (this.legend.hidden) return;
    const bar = element("div", { className: "bar" });
    bar.style.background = `linear-gradient(to right, ${MAP_COLOURS.join(",")})`;
    const ends = [0, most / 2, most].map((v) => element("span", { textContent: v.toFixed(1) }));
    this.legend.replaceChildren(
      element("div", { textContent: map ? _`Movement of the skin, mm` : _`Half the width of the band, mm (0: none is available)` }), bar,
      element("div", { className: "ends" }, ...ends));
  }
}

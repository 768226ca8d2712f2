// How the picture shows the face: opacity, before and after, side by side, colours of movement.

import { MAP_COLOURS } from "./colours.js";
import { element } from "./elements.js";
import { addViews, slider } from "./view_buttons.js";

/** What can be switched on, by key. */
const BOXES = { side: "Side by side", map: "Colour by movement", band: "Colour by uncertainty", handles: "Handles", pull: "Pull the skin" };

export class ViewPanel {
  /** boxes: the keys of what this page can show. */
  constructor(app, boxes) {
    this.app = app;
    this.values = { skin: 1, bones: 1, share: 1, side: false, map: false, band: false, handles: true, pull: false };
    addViews(app, "Whole face");
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
      element("div", { textContent: map ? "Movement of the skin, mm" : "Half the width of the band, mm (0: none is available)" }), bar,
      element("div", { className: "ends" }, ...ends));
  }
}

// How the picture shows the face: opacity, before and after, side by side, colours of movement.

import { VIEWS } from "./camera.js";
import { MAP_COLOURS } from "./colours.js";
import { button, element } from "./elements.js";

export class ViewPanel {
  constructor(app) {
    this.app = app;
    this.values = { skin: 1, bones: 1, share: 1, side: false, map: false, band: false, handles: true, pull: false };
    const views = document.getElementById("views");
    views.append(
      ...VIEWS.map((view, i) => button(view.name, () => this.look(i), { title: `key ${i + 1}` })),
      button("Whole face", () => { app.camera.recentre(); app.redraw(); }, { title: "key 0" }));
    const slider = (key, label) => element("label", {}, label, element("input", {
      type: "range", min: 0, max: 1, step: 0.01, value: this.values[key], id: `show-${key}`,
      oninput: (e) => this.set(key, Number(e.target.value)),
    }));
    const box = (key, label) => element("label", {}, element("input", {
      type: "checkbox", checked: this.values[key], id: `show-${key}`,
      onchange: (e) => this.set(key, e.target.checked),
    }), label);
    document.getElementById("controls").append(
      slider("share", "Before – after"), slider("skin", "Skin"), slider("bones", "Bones"),
      box("side", "Side by side"), box("map", "Colour by movement"),
      ...(app.face.band ? [box("band", "Colour by uncertainty")] : []), box("handles", "Handles"),
      box("pull", "Pull the skin"));
    this.legend = document.getElementById("legend");
  }

  look(index) {
    this.app.camera.look(VIEWS[index]);
    this.app.redraw();
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

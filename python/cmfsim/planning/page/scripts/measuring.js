// The distance between two points that are clicked on.

import { _, element, signed } from "./elements.js";
import { seenPoint } from "./picking.js";

// A surface fainter than this is not clicked on.
const SEEN = 0.3;
const INK = "#b3003c";

export class Ruler {
  /** surfaces(): what is shown, each as {places, triangles, opacity}; places are as they are drawn. */
  constructor(app, surfaces) {
    this.app = app;
    this.surfaces = surfaces;
    this.points = [];
    this.box = element("input", { type: "checkbox", id: "show-ruler", onchange: () => { this.points = []; this.show(); app.redraw(); } });
    this.note = element("span", { className: "note", role: "status" });
    document.getElementById("controls").append(element("label", {}, this.box, "Measure"), this.note);
  }

  /** A click: the first point, the second, or the first of the next distance. */
  clicked(at) {
    if (!this.box.checked) return;
    const { camera, overlay } = this.app;
    const found = this.surfaces().map((surface, number) => {
      if (surface.opacity < SEEN) return null;
      const seen = seenPoint(camera, surface.places, surface.triangles, at, overlay.clientWidth, overlay.clientHeight);
      return seen && { ...seen, number };
    }).reduce((a, b) => (!b || (a && a.depth >= b.depth) ? a : b), null);
    if (!found) return;
    if (this.points.length === 2) this.points = [];
    this.points.push(found);
    this.show();
    this.app.redraw();
  }

  /** Where the points are now: they move with their surfaces. */
  places() {
    const surfaces = this.surfaces();
    return this.points.map(({ number, triangle, shares }) => {
      const { places, triangles } = surfaces[number];
      return [0, 1, 2].map((axis) => shares.reduce((sum, share, k) => sum + share * places[3 * triangles[3 * triangle + k] + axis], 0));
    });
  }

  show() {
    const [a, b] = this.places();
    this.note.textContent = !this.box.checked ? "" : b
      ? _`${Math.hypot(...a.map((v, k) => v - b[k])).toFixed(1)} mm between the points (left ${signed(b[0] - a[0])}, forwards ${signed(a[1] - b[1])}, up ${signed(b[2] - a[2])})`
      : _`Click on ${a ? _`the second` : "a first"} point of skin or bone.`;
  }

  draw(pen, camera, width, height) {
    if (!this.points.length) return;
    const seen = this.places().map((place) => camera.project(place, width, height));
    this.show();
    pen.strokeStyle = pen.fillStyle = INK;
    pen.lineWidth = 2;
    pen.beginPath();
    seen.forEach((p, i) => (i ? pen.lineTo(...p) : pen.moveTo(...p)));
    pen.stroke();
    for (const [x, y] of seen) {
      pen.beginPath();
      pen.arc(x, y, 4, 0, 2 * Math.PI);
      pen.fill();
    }
  }
}

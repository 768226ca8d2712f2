// The mirror image of the face, and how far its middle is off the plane of symmetry.

import { _, element } from "./elements.js";

const IMAGE_COLOUR = [0.25, 0.5, 0.95], IMAGE_OPACITY = 0.45;
const product3 = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);

/** How far a point lies to the left of a plane, mm. */
const leftOf = ({ point, normal }, place) => product3(normal, place) - product3(normal, point);

/** The reflection as a matrix, row by row. */
function reflection({ point, normal: n }) {
  const rows = n.map((a, r) => [...n.map((b, c) => (r === c ? 1 : 0) - 2 * a * b), 2 * product3(n, point) * a]);
  return [...rows.flat(), 0, 0, 0, 1];
}

/** A box that shows the mirror image of a skin, and a line on the middle of the face. */
export class Mirror {
  /** plane: a point and a unit normal to the left, or null; places(): the sites of the skin by name as they are shown. */
  constructor(app, plane, places) {
    Object.assign(this, { plane, places });
    this.box = element("input", { type: "checkbox", id: "show-mirror", onchange: () => { this.show(); app.redraw(); } });
    this.note = element("div", { className: "note", role: "status" });
    if (this.plane) document.getElementById("controls").append(element("label", {}, this.box, _`Mirror image`), this.note);
  }

  /** The mirror image of a surface, to be drawn with the others. */
  parts(surface) {
    return this.box.checked ? [{ surface, colour: IMAGE_COLOUR, opacity: IMAGE_OPACITY, motion: reflection(this.plane), scale: 0 }] : [];
  }

  show() {
    this.note.textContent = "";
    if (!this.box.checked) return;
    const middle = Object.entries(this.places()).filter(([name]) => !/_[LR]$/.test(name));
    const texts = middle.map(([name, place]) => {
      const off = leftOf(this.plane, place);
      return _`${name.replaceAll("_", " ")} ${Math.abs(off).toFixed(1)} mm${Math.abs(off) < 0.05 ? "" : off > 0 ? " left" : " right"}`;
    });
    this.note.textContent = _`Blue: mirror image at the plane between the corners of the eyes. Skin in the middle of the face: ${texts.join(", ")}.`;
  }
}

// A face before and after an operation, to turn, within a report.

import { Camera } from "./camera.js";
import { SKIN, STILL_BONE, mapped, rgb } from "./colours.js";
import { Drawing, vertexNormals } from "./drawing.js";
import { _, cleared } from "./elements.js";
import { Ruler } from "./measuring.js";
import { connectKeys, connectPointing } from "./pointing.js";
import { STAYS } from "./rigid.js";
import { start } from "./unpacking.js";
import { ViewPanel } from "./view_panel.js";

const GROUND = [0.933, 0.945, 0.961];

/** A surface that moves by a shift of each vertex. */
class Moving {
  constructor(drawing, { kind, colour }, before, triangles, shift, paint) {
    Object.assign(this, { drawing, kind, before, triangles, shift });
    this.colour = paint ? [1, 1, 1] : kind === "skin" ? SKIN : colour === null ? STILL_BONE : rgb(colour);
    this.still = drawing.surface(before, triangles, paint);
    this.now = drawing.surface(before, triangles, paint);
    this.places = Float32Array.from(before);
    this.normals = new Float32Array(before.length);
    this.amounts = new Float32Array(before.length / 3).map((_, i) => Math.hypot(...shift.subarray(3 * i, 3 * i + 3)));
  }

  /** Goes to a share of its way. */
  place(share) {
    for (let i = 0; i < this.places.length; i++) this.places[i] = this.before[i] + share * this.shift[i];
    vertexNormals(this.normals, this.places, this.triangles);
    this.drawing.update(this.now, this.places, this.normals, this.amounts);
  }
}

class App {
  constructor(page, arrays) {
    const begun = performance.now();
    this.isPart = true;
    this.camera = new Camera(page.target, page.span);
    this.drawing = new Drawing(document.getElementById("drawing"), Array.from({ length: 64 }, (_, i) => mapped(i / 63)));
    this.overlay = document.getElementById("overlay");
    const take = (name) => arrays[name].values;
    // Bones first: what is seen through is drawn over them.
    this.parts = page.parts.map((part, i) => new Moving(this.drawing, part, take(`part_${i}`), take(`part_${i}_triangles`), take(`part_${i}_shift`), part.kind === "skin" ? arrays.skin_colours?.values : null));
    this.most = page.most;
    this.view = new ViewPanel(this, ["side", "map"]);
    this.ruler = new Ruler(this, () => this.parts.map(({ kind, places, triangles }) => ({ places, triangles, opacity: this.view.values[kind] })));
    connectPointing(this);
    connectKeys(this);
    new ResizeObserver(() => this.redraw()).observe(this.overlay);
    this.reshow();
    this.timing = { compute: performance.now() - begun };
  }

  canGrab() { return false; }
  grab() { return null; }
  clicked(at) {
    if (!this.view.values.side) this.ruler.clicked(at);
  }
  undo() {}
  redo() {}

  reshow() {
    this.stale = true;
    this.redraw();
  }

  redraw() {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      if (this.stale) for (const part of this.parts) part.place(this.view.values.share);
      this.stale = false;
      this.draw();
    });
  }

  shown(before) {
    const { map } = this.view.values;
    return this.parts.map(({ kind, colour, still, now }) => ({
      surface: before ? still : now, colour, motion: STAYS, opacity: this.view.values[kind],
      scale: map && kind === "skin" && !before ? 1 / this.most : 0,
    }));
  }

  draw() {
    const { side, share } = this.view.values;
    const { drawing, camera } = this;
    drawing.fit();
    drawing.clear(GROUND);
    if (side) drawing.draw(camera, this.shown(true), 0, 0.5);
    drawing.draw(camera, this.shown(false), side ? 0.5 : 0, 1);
    const { pen, width, height } = cleared(this.overlay);
    if (!side) this.ruler.draw(pen, camera, width, height);
    const after = share === 1 ? _`After` : share === 0 ? _`Before` : _`${Math.round(100 * share)} % of the way`;
    document.getElementById("caption-left").textContent = side ? _`Before` : after;
    document.getElementById("caption-right").textContent = side ? after : "";
    this.view.showLegend(this.most);
  }
}

await start(App);

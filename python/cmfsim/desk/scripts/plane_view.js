// The planes of the cuts in the picture, and the handles by which they are dragged.

import { _ } from "./elements.js";
import { STAYS } from "./rigid.js";

// A plane that three others and the box of its bone clip has at most this many corners.
const CORNERS = 16;
const GRAB = 14;
const COLOUR = [0.1, 0.45, 0.75];

export class PlaneView {
  /** app gives: drawing, camera, overlay, redraw(), and cutting, whose options are dragged. */
  constructor(app) {
    this.app = app;
    this.surfaces = [];
    this.count = 0;
    this.handles = [];
  }

  show(planes, handles) {
    this.count = planes.length;
    planes.forEach(({ points }, i) => {
      const places = new Float32Array(3 * CORNERS);
      for (let k = 0; k < CORNERS; k++) places.set(points[Math.min(k, points.length - 1)], 3 * k);
      if (this.surfaces[i]) this.app.drawing.update(this.surfaces[i], places);
      else this.surfaces.push(this.app.drawing.surface(places, fan()));
    });
    // A handle lies in the middle of what is drawn of its plane.
    this.handles = handles.flatMap((handle) => {
      const plane = planes.find((p) => p.kind === handle.kind && p.name === handle.name);
      return plane ? [{ ...handle, point: middle(plane.points) }] : [];
    });
  }

  parts() {
    return this.surfaces.slice(0, this.count).map((surface) => ({ surface, colour: COLOUR, opacity: 0.35, motion: STAYS }));
  }

  get size() { return [this.app.overlay.clientWidth, this.app.overlay.clientHeight]; }

  /** The handle at a place of the picture; null where there is none. */
  at([x, y]) {
    const away = ({ point }) => {
      const [px, py] = this.app.camera.project(point, ...this.size);
      return Math.hypot(px - x, py - y);
    };
    const near = this.handles.filter((h) => away(h) <= GRAB).sort((a, b) => away(a) - away(b));
    return near[0] ?? null;
  }

  /** Names the handle at a place of the picture; whether there is one. */
  points(at) {
    const was = this.pointed;
    this.pointed = this.at(at);
    if (this.pointed !== was) this.app.redraw();
    return this.pointed !== null;
  }

  grab(at) {
    const handle = this.at(at);
    if (!handle) return null;
    const { app } = this;
    const was = app.cutting.value(handle.kind, handle.option);
    return {
      drag: (to) => {
        // How far a unit of the option is seen to move, in pixels.
        const [ax, ay] = app.camera.project(handle.point, ...this.size);
        const [bx, by] = app.camera.project(handle.point.map((v, k) => v + handle.way[k]), ...this.size);
        const length = (bx - ax) ** 2 + (by - ay) ** 2;
        // Seen along its way, a plane cannot be dragged.
        if (length < 0.05) return;
        const moved = ((to[0] - at[0]) * (bx - ax) + (to[1] - at[1]) * (by - ay)) / length;
        app.cutting.set(handle.kind, handle.option, was + moved);
      },
      release: () => app.cutting.keep(),
    };
  }

  /** Draws the handles over the picture. */
  mark() {
    const { overlay, camera } = this.app;
    const ratio = globalThis.devicePixelRatio || 1;
    const [width, height] = this.size;
    overlay.width = Math.round(width * ratio);
    overlay.height = Math.round(height * ratio);
    const pen = overlay.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = "600 12px system-ui, sans-serif";
    for (const { point, way, kind, option } of this.handles) {
      const [x, y] = camera.project(point, width, height);
      const size = Math.hypot(...way);
      const [tx, ty] = camera.project(point.map((v, k) => v + (10 * way[k]) / size), width, height);
      for (const [thick, colour] of [[5, "#ffffffcc"], [2, "#0b5cad"]]) {
        pen.lineWidth = thick;
        pen.strokeStyle = colour;
        pen.beginPath();
        pen.moveTo(2 * x - tx, 2 * y - ty);
        pen.lineTo(tx, ty);
        pen.stroke();
      }
      pen.fillStyle = "#0b5cad";
      pen.beginPath();
      pen.arc(x, y, 7, 0, 2 * Math.PI);
      pen.fill();
      pen.strokeStyle = "#fff";
      pen.stroke();
      if (option !== this.pointed?.option || kind !== this.pointed.kind) continue;
      pen.lineWidth = 4;
      pen.strokeText(option, x + 11, y + 4);
      pen.fillText(option, x + 11, y + 4);
    }
  }
}

const fan = () => Uint32Array.from(Array.from({ length: CORNERS - 2 }, (_, k) => [0, k + 1, k + 2]).flat());

const middle = (points) => [0, 1, 2].map((k) => points.reduce((sum, p) => sum + p[k], 0) / points.length);

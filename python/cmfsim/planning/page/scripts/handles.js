// Handles on the chosen segment: three arrows to pull and three rings to turn, over the picture.

import { cleared } from "./elements.js";
import { moved } from "./rigid.js";

const REACH = 16;
const SIZE = 0.13;
const STEPS = 48;
const AXES = [
  { pull: "left", turn: "pitch", turnSign: -1, colour: "#0072b2", axis: [1, 0, 0] },
  { pull: "forwards", turn: "roll", turnSign: 1, colour: "#d55e00", axis: [0, -1, 0] },
  { pull: "up", turn: "yaw", turnSign: 1, colour: "#009e73", axis: [0, 0, 1] },
];

export class Handles {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.shapes = [];
    this.held = null;
  }

  /** Draws the handles at where `motion` takes `point`; turns are about `centre`. */
  draw(camera, motion, point, centre) {
    const { pen, width, height } = cleared(this.canvas);
    this.shapes = [];
    if (!motion) return;
    const size = SIZE * camera.span;
    const at = moved(motion, point);
    const about = moved(motion, centre);
    for (const axis of AXES) {
      this.arrow(pen, camera, at, axis, size, [width, height]);
      this.ring(pen, camera, about, axis, 0.8 * size, [width, height]);
    }
  }

  arrow(pen, camera, at, { pull, axis, colour }, size, [width, height]) {
    const from = camera.project(at, width, height);
    const to = camera.project(at.map((v, i) => v + size * axis[i]), width, height);
    const way = [to[0] - from[0], to[1] - from[1]];
    const length = Math.hypot(...way);
    // An arrow that points at the viewer cannot be pulled.
    if (length < 14) return;
    const held = this.held?.key === pull;
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = held ? 5 : 3;
    pen.beginPath();
    pen.moveTo(...from);
    pen.lineTo(...to);
    pen.stroke();
    const [ux, uy] = way.map((v) => v / length);
    pen.beginPath();
    pen.moveTo(to[0] + 9 * ux, to[1] + 9 * uy);
    pen.lineTo(to[0] - 6 * uy, to[1] + 6 * ux);
    pen.lineTo(to[0] + 6 * uy, to[1] - 6 * ux);
    pen.fill();
    // mm per pixel along the arrow.
    this.shapes.push({ key: pull, points: [from, [to[0] + 9 * ux, to[1] + 9 * uy]], way: [ux, uy], step: size / length });
  }

  ring(pen, camera, at, { turn, turnSign, axis, colour }, size, [width, height]) {
    const { towards } = camera.axes();
    const facing = axis.reduce((sum, v, i) => sum + v * towards[i], 0);
    // A ring seen from its edge cannot be turned.
    if (Math.abs(facing) < 0.2) return;
    const others = AXES.map((a) => a.axis).filter((a) => a !== axis);
    const points = Array.from({ length: STEPS + 1 }, (_, k) => {
      const [c, s] = [Math.cos((2 * Math.PI * k) / STEPS), Math.sin((2 * Math.PI * k) / STEPS)];
      return camera.project(at.map((v, i) => v + size * (c * others[0][i] + s * others[1][i])), width, height);
    });
    pen.strokeStyle = colour;
    pen.lineWidth = this.held?.key === turn ? 4 : 2;
    pen.setLineDash([6, 4]);
    pen.beginPath();
    points.forEach((p, i) => (i ? pen.lineTo(...p) : pen.moveTo(...p)));
    pen.stroke();
    pen.setLineDash([]);
    // Anticlockwise in the picture is positive about an axis that points at the viewer.
    const sign = turnSign * Math.sign(facing);
    this.shapes.push({ key: turn, points, middle: camera.project(at, width, height), sign });
  }

  /** The handle at a place of the picture; null where there is none. */
  at(x, y) {
    let best = null;
    for (const shape of this.shapes) {
      for (let i = 1; i < shape.points.length; i++) {
        const away = fromStretch([x, y], shape.points[i - 1], shape.points[i]);
        if (away <= (best?.away ?? REACH)) best = { shape, away };
      }
    }
    return best?.shape ?? null;
  }

  grab(shape, x, y) {
    this.held = { ...shape, from: [x, y], angle: shape.middle ? turned(shape.middle, x, y) : 0, sum: 0 };
  }

  /** What the held handle adds to its number since it was grabbed, mm or degrees. */
  pulled(x, y) {
    const held = this.held;
    if (held.way) return held.step * ((x - held.from[0]) * held.way[0] + (y - held.from[1]) * held.way[1]);
    const now = turned(held.middle, x, y);
    // The shorter way round, so that a turn past 180° does not jump.
    held.sum += ((now - held.angle + 540) % 360) - 180;
    held.angle = now;
    return held.sign * held.sum;
  }

  release() {
    this.held = null;
  }
}

/** The angle of a place about a middle, degrees anticlockwise in the picture. */
const turned = ([mx, my], x, y) => (Math.atan2(my - y, x - mx) * 180) / Math.PI;

function fromStretch([x, y], [ax, ay], [bx, by]) {
  const [ux, uy] = [bx - ax, by - ay];
  const along = Math.max(0, Math.min(1, ((x - ax) * ux + (y - ay) * uy) / (ux * ux + uy * uy || 1)));
  return Math.hypot(x - ax - along * ux, y - ay - along * uy);
}

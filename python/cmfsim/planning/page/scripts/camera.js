// A parallel projection that turns about a point: what is equally long looks equally long.
//
// Angles in degrees: azimuth 0 and elevation 0 look at the face from the front; azimuth 90 from the
// patient's left; elevation −90 from below.

import { _ } from "./elements.js";
import { DEGREE } from "./rigid.js";

export const VIEWS = [
  { name: _`Front`, azimuth: 0, elevation: 0 },
  { name: _`Right profile`, azimuth: -90, elevation: 0 },
  { name: _`Left profile`, azimuth: 90, elevation: 0 },
  { name: _`Three-quarter`, azimuth: -40, elevation: 5 },
  { name: _`From below`, azimuth: 0, elevation: -89.9 },
  { name: _`From above`, azimuth: 0, elevation: 89.9 },
];

export class Camera {
  /** target: the point in the middle, mm; span: what the height of the picture shows, mm. */
  constructor(target, span) {
    this.home = { target: [...target], span };
    this.target = [...target];
    this.span = span;
    this.azimuth = -40;
    this.elevation = 5;
  }

  look({ azimuth, elevation }) {
    this.azimuth = azimuth;
    this.elevation = elevation;
  }

  /** Back to the whole face, from the same side. */
  recentre() {
    this.target = [...this.home.target];
    this.span = this.home.span;
  }

  turn(dx, dy) {
    this.azimuth = ((this.azimuth + dx + 540) % 360) - 180;
    this.elevation = Math.max(-89.9, Math.min(89.9, this.elevation + dy));
  }

  zoom(factor) {
    this.span = Math.max(20, Math.min(1000, this.span * factor));
  }

  /** Moves the picture by a share of its height. */
  pan(dx, dy) {
    const { right, up } = this.axes();
    for (let i = 0; i < 3; i++) this.target[i] -= this.span * (dx * right[i] + dy * up[i]);
  }

  /** Unit vectors: to the right and up in the picture, and towards the viewer. */
  axes() {
    const a = this.azimuth * DEGREE;
    const e = this.elevation * DEGREE;
    const towards = [Math.sin(a) * Math.cos(e), -Math.cos(a) * Math.cos(e), Math.sin(e)];
    const right = [Math.cos(a), Math.sin(a), 0];
    const up = [
      towards[1] * right[2] - towards[2] * right[1],
      towards[2] * right[0] - towards[0] * right[2],
      towards[0] * right[1] - towards[1] * right[0],
    ];
    return { right, up, towards };
  }

  /** From mm to clip coordinates, 16 numbers column by column as WebGL takes them. */
  matrix(aspect) {
    const { right, up, towards } = this.axes();
    const along = (v) => v[0] * this.target[0] + v[1] * this.target[1] + v[2] * this.target[2];
    const y = 2 / this.span;
    const x = y / aspect;
    const z = -1 / 600;
    return [
      x * right[0], y * up[0], z * towards[0], 0,
      x * right[1], y * up[1], z * towards[1], 0,
      x * right[2], y * up[2], z * towards[2], 0,
      -x * along(right), -y * along(up), -z * along(towards), 1,
    ];
  }

  /** Where a point appears in a picture of this size, in pixels from its upper left corner. */
  project(point, width, height) {
    const { right, up } = this.axes();
    const scale = height / this.span;
    const away = point.map((v, i) => v - this.target[i]);
    const along = (v) => v[0] * away[0] + v[1] * away[1] + v[2] * away[2];
    return [width / 2 + scale * along(right), height / 2 - scale * along(up)];
  }
}

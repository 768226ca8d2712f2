// The midline profile, before and after, seen from the patient's right; and under it a photograph of the
// profile, placed by landmarks that a person clicks on.

import { DISTINCT } from "./colours.js";
import { _, button, element } from "./elements.js";
import { fileName, save } from "./exporting.js";

const MARGIN = 10;
// Landmarks in the middle of the face, from top to bottom, and how many are needed.
const SITES = ["glabella", "nasion", "pronasale", "subnasale", "labiale_superius", "labiale_inferius", "sublabiale", "pogonion", "menton"];
const LEAST = 3;
// Root mean square distance, mm, above which landmarks do not fit; by which ratio one side fits better than the other; pixels that are kept.
const MOST_ERROR = 5, CLEARER = 0.6, MOST_PIXELS = 2000;

/** Strokes polylines of (y, z), mm, at their places in a picture; `unit`: of their thickness, pixels. */
function drawLines(pen, lines, place, unit = 1) {
  for (const { points, colour, thick, dash } of lines) {
    pen.strokeStyle = colour;
    pen.lineWidth = thick * unit;
    pen.setLineDash((dash ?? []).map((length) => length * unit));
    pen.beginPath();
    points.forEach((p, i) => (i && p[2] !== false ? pen.lineTo(...place(p)) : pen.moveTo(...place(p))));
    pen.stroke();
  }
  pen.setLineDash([]);
}

/** Draws polylines of (y, z) in mm: [{points, colour, width, dash}], with a bar of 10 mm. */
export function drawProfile(canvas, lines) {
  const ratio = globalThis.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const all = lines.flatMap((line) => line.points);
  if (!all.length || !width) return;
  const [ys, zs] = [0, 1].map((i) => all.map((p) => p[i]));
  const [low, high] = [Math.min(...ys), Math.max(...ys)];
  const [bottom, top] = [Math.min(...zs), Math.max(...zs)];
  const scale = Math.min((width - 2 * MARGIN) / (high - low), (height - 2 * MARGIN) / (top - bottom));
  // Forwards (−P) to the right.
  const place = ([y, z]) => [
    width / 2 - scale * (y - (low + high) / 2),
    height / 2 - scale * (z - (bottom + top) / 2),
  ];
  drawLines(pen, lines, place);
  pen.strokeStyle = pen.fillStyle = "#3a4450";
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(MARGIN, height - MARGIN);
  pen.lineTo(MARGIN + 10 * scale, height - MARGIN);
  pen.stroke();
  pen.font = "12px system-ui, sans-serif";
  pen.fillText("10 mm", MARGIN, height - MARGIN - 5);
}

export const variantColour = (index) => DISTINCT[index % DISTINCT.length];

/** The similarity from (y, z), mm, to pixels that fits points best, for each side to which the face may look; best first. */
function fitted(sites, pixels) {
  const middle = (rows) => [0, 1].map((k) => rows.reduce((sum, row) => sum + row[k], 0) / rows.length);
  const fits = [-1, 1].map((side) => {
    const flat = ([y, z]) => [side * y, -z];
    const [m, q] = [middle(sites.map(flat)), middle(pixels)];
    let [re, im, size] = [0, 0, 0];
    sites.map(flat).forEach(([u, v], i) => {
      const [a, b, c, d] = [u - m[0], v - m[1], pixels[i][0] - q[0], pixels[i][1] - q[1]];
      [re, im, size] = [re + a * c + b * d, im + a * d - b * c, size + a * a + b * b];
    });
    const [c, s] = [re / size, im / size];
    const place = (site) => {
      const [a, b] = flat(site).map((v, k) => v - m[k]);
      return [q[0] + c * a - s * b, q[1] + s * a + c * b];
    };
    const off = sites.map((site, i) => Math.hypot(...place(site).map((v, k) => v - pixels[i][k])));
    return { place, error: Math.hypot(...off) / Math.sqrt(off.length) / Math.hypot(c, s) };
  });
  return fits.sort((a, b) => a.error - b.error);
}

export class ProfilePhoto {
  constructor(app) {
    Object.assign(this, { app, photo: null, points: [], lines: [] });
    const known = new Set(app.page.skin_sites.map(({ name }) => name));
    this.sites = SITES.filter((name) => known.has(name));
    this.file = element("input", { type: "file", accept: "image/jpeg,image/png", id: "photo-file", onchange: (e) => this.load(e.target) });
    this.canvas = element("canvas", { className: "photo", role: "img", "aria-label": _`Photograph of the profile`, hidden: true, onclick: (e) => this.click(e) });
    this.note = element("p", { className: "note", role: "status", id: "photo-note" });
    this.tools = element("div", { className: "row", hidden: true },
      button(_`Skip this point`, () => this.take(null), { id: "photo-skip" }),
      button(_`Start again`, () => this.restart(), { id: "photo-again" }),
      button(_`Save the photo (PNG)`, () => this.savePicture(), { id: "photo-save" }));
    this.root = element("div", {},
      element("div", { className: "row" }, element("label", { for: "photo-file", textContent: _`Photo of the profile` }), this.file),
      this.canvas, this.note, this.tools);
  }

  async load(input) {
    const file = input.files[0];
    if (!file) return;
    try {
      const image = await createImageBitmap(file);
      const scale = Math.min(1, MOST_PIXELS / Math.max(image.width, image.height));
      this.photo = element("canvas", { width: Math.round(scale * image.width), height: Math.round(scale * image.height) });
      this.photo.getContext("2d").drawImage(image, 0, 0, this.photo.width, this.photo.height);
      this.canvas.hidden = this.tools.hidden = false;
      this.restart();
    } catch {
      this.app.report(_`${file.name}: is no JPEG or PNG that the browser can read. No photo was loaded.`);
    }
    input.value = "";
  }

  restart() {
    this.points = [];
    this.show(this.lines);
  }

  click(event) {
    const { canvas } = this;
    const { left, top, width, height } = canvas.getBoundingClientRect();
    this.take([(event.clientX - left) * canvas.width / width, (event.clientY - top) * canvas.height / height]);
  }

  /** The place of the next landmark in the photo; null where it is not seen. */
  take(pixel) {
    if (this.points.length < this.sites.length) this.points.push(pixel);
    this.show(this.lines);
  }

  /** The place of (y, z), mm, in the photo; or why there is none. */
  placed() {
    const places = this.app.face.sitePlaces(null);
    const used = this.sites.filter((_, i) => this.points[i]);
    if (used.length < LEAST) return { why: _`${LEAST - used.length} more needed.` };
    const [best, other] = fitted(used.map((name) => places[name].slice(1)), this.points.filter(Boolean));
    if (!(best.error <= MOST_ERROR)) {
      return { why: _`The points do not fit this face: they are ${best.error.toFixed(1)} mm off, at most ${MOST_ERROR} mm are allowed. Check the order, and that the photo is a profile of this patient.` };
    }
    if (best.error > CLEARER * other.error) return { why: _`The points do not show to which side the face looks: click on the tip of the nose as well.` };
    return best;
  }

  /** Draws the photo with the profiles, which follow the plan. */
  show(lines) {
    this.lines = lines;
    const { photo, canvas, points, sites } = this;
    if (!photo) return;
    Object.assign(canvas, { width: photo.width, height: photo.height });
    const pen = canvas.getContext("2d"), unit = photo.width / (canvas.clientWidth || photo.width);
    pen.drawImage(photo, 0, 0);
    this.fit = this.placed();
    if (this.fit.place) drawLines(pen, lines, this.fit.place, unit);
    Object.assign(pen, { strokeStyle: "#d0021b", lineWidth: 1.5 * unit });
    points.filter(Boolean).forEach(([x, y]) => {
      pen.beginPath();
      pen.arc(x, y, 4 * unit, 0, 2 * Math.PI);
      pen.stroke();
    });
    const next = sites[points.length];
    const state = this.fit.place ? _`Dashed: before; solid: variant ${this.app.plans.active.name}. The points fit to ${this.fit.error.toFixed(1)} mm (root mean square).` : this.fit.why;
    this.note.textContent = _`${next ? _`Click on ${next.replaceAll("_", " ")} in the photo. ` : ""}${state}`;
  }

  savePicture() {
    const { app, canvas, fit } = this;
    if (!fit?.place) {
      app.report(_`The photo has no profiles yet. ${fit?.why ?? ""}`);
      return;
    }
    const pen = canvas.getContext("2d"), size = Math.max(12, canvas.width / 60);
    const text = _`${app.page.case}, variant ${app.exporting.stem.split("-").at(-1)}: dashed before, solid predicted. Not a medical device.`;
    pen.fillStyle = "#ffffffcc";
    pen.fillRect(0, canvas.height - 2 * size, canvas.width, 2 * size);
    Object.assign(pen, { fillStyle: "#1d2530", font: `${size}px system-ui, sans-serif` });
    pen.fillText(text, size, canvas.height - 0.6 * size, canvas.width - 2 * size);
    canvas.toBlob((blob) => save(`${app.exporting.stem}-${fileName("photo")}.png`, blob, "image/png"));
    this.show(this.lines);
  }
}

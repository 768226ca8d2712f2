// The page of landmarks: sites that are placed, those that follow, and everything that shows them.

import { STATES, ballMotion, ballRadius, unitBall } from "./balls.js";
import { Camera } from "./camera.js";
import { ClosestPoint } from "./closest.js";
import { SKIN, STILL_BONE, rgb } from "./colours.js";
import { Drawing } from "./drawing.js";
import { _, cleared, element } from "./elements.js";
import { FilesPanel } from "./files_panel.js";
import { History } from "./history.js";
import { seenPoint } from "./picking.js";
import { connectKeys, connectPointing } from "./pointing.js";
import { STAYS } from "./rigid.js";
import { SiteModel } from "./site_model.js";
import { SitePanel } from "./site_panel.js";
import { start } from "./unpacking.js";
import { addViews, slider } from "./view_panel.js";

const BACKGROUND = [0.933, 0.945, 0.961];
const JAW = [0.80, 0.84, 0.87];
const MESSAGE_MS = 8000;
// How near to a ball a press takes hold of it, pixels; how far in front of a ball hides it, mm.
const GRAB = 12, HIDES = 3;
// A part shown fainter than SEEN cannot be clicked on. The skin over a chosen site of the bone.
const SEEN = 0.3, FAINT = 0.12;
const FLIGHT_MS = 350;
const TO_CHECK = ["missing", "doubtful"];

class App {
  constructor(page, arrays) {
    this.page = page;
    this.arrays = arrays;
    page.sites.forEach((site) => {
      site.label = labelOf(site.name) + (site.kind === "skin" ? " (skin)" : "");
    });
    this.points = page.sites.map((_, i) => [...arrays.site_points.values.slice(3 * i, 3 * i + 3)]);
    this.model = new SiteModel(this.points.flat(), arrays.site_covariance.values, page.placed_std);
    this.errorsBefore = this.model.given([]).errors;
    this.camera = new Camera(page.target, page.span);
    this.drawing = new Drawing(document.getElementById("drawing"), [[0, 0, 0], [1, 1, 1]]);
    this.overlay = document.getElementById("overlay");
    this.surfaces = page.surfaces.map(({ name, part }, i) => {
      const [places, triangles] = [arrays[`surface_${i}`].values, arrays[`surface_${i}_triangles`].values];
      return { name, part, places, triangles, drawn: this.drawing.surface(places, triangles), closest: new ClosestPoint(places, triangles) };
    });
    const ball = unitBall();
    this.ball = this.drawing.surface(ball.places, ball.triangles);
    this.opacity = { cranium: 1, mandible: 1, skin: FAINT };
    this.history = new History(new Map(page.sites.flatMap((s, i) => (s.placed ? [[i, { point: s.placed, origin: s.placed_origin }]] : []))));
    this.savedAt = this.history.now;
    this.timing = { compute: 0 };
    this.build();
  }

  get site() { return this.page.sites[this.chosen]; }
  /** What a person placed or accepted: by the number of the site, {point, origin}. */
  get decided() { return this.pending ?? this.history.now; }

  build() {
    this.shown = this.derived(this.decided);
    this.order = this.page.sites.map((_, i) => i);
    this.chosen = this.toCheck()[0] ?? 0;
    this.panel = new SitePanel(this);
    this.files = new FilesPanel(this);
    document.getElementById("panel").append(this.panel.root, this.files.root);
    addViews(this, _`Whole head`);
    const parts = { cranium: "Cranium", mandible: "Mandible", skin: "Skin" };
    document.getElementById("controls").append(
      ...Object.entries(parts).filter(([part]) => this.surfaces.some((s) => s.part === part)).map(([part, label]) =>
        slider(`show-${part}`, label, this.opacity[part], (value) => { this.opacity[part] = value; this.redraw(); })),
      element("span", { className: "note", textContent: _`Drag to rotate, Shift-drag to move, wheel to zoom. N and P: next and previous to check; Enter: accept; Delete: remove; Ctrl+Z: undo.` }));
    connectPointing(this);
    connectKeys(this);
    document.addEventListener("keydown", (e) => this.pressed(e));
    globalThis.addEventListener("beforeunload", (e) => { if (this.savedAt !== this.history.now) e.preventDefault(); });
    new ResizeObserver(() => this.redraw()).observe(this.overlay);
    this.choose(this.chosen);
  }

  // Sites -------------------------------------------------------------------------------------------

  /** Where all sites are if those of `decided` are where a person put them. */
  derived(decided) {
    const begun = performance.now();
    const sites = [...decided.keys()].sort((a, b) => a - b);
    const shifts = this.model.shifts(sites, sites.map((i) => decided.get(i).point));
    const { errors } = this.model.given(sites);
    const good = (i) => sites.length > 0 && errors[i] <= this.page.good_error;
    const shown = this.page.sites.map((site, i) => {
      const given = decided.get(i);
      if (given) return { state: given.origin, point: given.point, error: 0, moved: 0, onSurface: true };
      const shift = [...shifts.slice(3 * i, 3 * i + 3)];
      const free = this.points[i].map((v, k) => v + shift[k]);
      const follows = site.origin === "filled" || Math.hypot(...shift) > 0.05;
      const near = follows ? this.closest(site.part, free) : { point: free, distance: 0 };
      const onSurface = near.distance <= this.page.surface_reach;
      const point = onSurface ? near.point : free;
      const share = errors[i] / this.errorsBefore[i];
      const moved = Math.hypot(...point.map((v, k) => v - this.points[i][k]));
      const state = site.origin === "filled" ? (good(i) && onSurface ? "filled" : "missing")
        : site.doubt ? (good(i) && share <= this.page.cleared_share ? "moved" : "doubtful") : "proposed";
      const error = state === "doubtful" ? Math.max(errors[i], share * site.error)
        : site.origin === "filled" || site.doubt ? errors[i] : Math.min(site.error, errors[i]);
      return { state, point, error, moved, onSurface };
    });
    this.timing.compute = Math.max(1e-3, performance.now() - begun);
    return shown;
  }

  /** The closest point of the surfaces of a part, and its distance, mm. */
  closest(part, point) {
    const found = this.surfaces.filter((s) => s.part === part).map((s) => s.closest.of(point));
    return found.reduce((a, b) => (a.distance <= b.distance ? a : b), { point, distance: Infinity });
  }

  away(part, point) { return this.closest(part, point).distance; }

  toCheck() {
    return this.page.sites.map((_, i) => i).filter((i) => TO_CHECK.includes(this.shown[i].state));
  }

  get partner() {
    const { kind, name } = this.site;
    if (!/_[LR]$/.test(name)) return null;
    const wanted = name.slice(0, -1) + (name.endsWith("L") ? "R" : "L");
    const found = this.page.sites.findIndex((s) => s.kind === kind && s.name === wanted);
    return found < 0 ? null : found;
  }

  /** Takes what is decided from now on; the state before can be had back by undo. */
  decide(decided) {
    this.pending = null;
    this.history.take(decided);
    this.changed();
  }

  put(i, point, origin = "placed") {
    this.decide(new Map([...this.history.now, [i, { point, origin }]]));
  }

  undo() { if (this.history.undo()) this.changed(); }
  redo() { if (this.history.redo()) this.changed(); }

  changed() {
    this.shown = this.derived(this.decided);
    this.panel.show();
    this.files.show();
    this.showState();
    this.redraw();
  }

  accept() {
    const { state, point, onSurface } = this.shown[this.chosen];
    if (state === "placed" || state === "accepted" || !onSurface) return;
    const { label } = this.site;
    this.put(this.chosen, [...point], "accepted");
    this.report(_`${label} accepted.`);
    this.step(1);
  }

  remove() {
    if (!this.decided.has(this.chosen)) return;
    const left = new Map(this.history.now);
    left.delete(this.chosen);
    this.decide(left);
    this.report(_`${this.site.label} is no longer placed.`);
  }

  /** Places the other side at the mirror image of the chosen site. */
  mirror() {
    const other = this.partner;
    if (other === null || !this.decided.has(this.chosen)) return;
    const image = mirrored(this.decided.get(this.chosen).point, this.midplane());
    const near = this.closest(this.site.part, image);
    if (near.distance > this.page.surface_reach) {
      this.report(_`There is no ${this.site.part} at the mirror image.`);
      return;
    }
    this.put(other, near.point);
    this.choose(other);
    this.report(_`${this.site.label} placed at the mirror image: check it.`);
  }

  /** The plane of symmetry of the sites without doubt: a point and a unit normal to the left. */
  midplane() {
    const trusted = (i) => !TO_CHECK.includes(this.shown[i].state);
    const named = new Map(this.page.sites.map((s, i) => [`${s.kind} ${s.name}`, i]));
    const middles = [], across = [0, 0, 0];
    this.page.sites.forEach(({ kind, name, part }, i) => {
      if (!trusted(i) || part === "mandible") return;
      const { point } = this.shown[i];
      if (!/_[LR]$/.test(name)) middles.push(point);
      const j = named.get(`${kind} ${name.replace(/_L$/, "_R")}`);
      if (!name.endsWith("_L") || j === undefined || !trusted(j)) return;
      const right = this.shown[j].point;
      middles.push(point.map((v, k) => (v + right[k]) / 2));
      point.forEach((v, k) => { across[k] += v - right[k]; });
    });
    const size = Math.hypot(...across);
    const normal = size > 0 ? across.map((v) => v / size) : [1, 0, 0];
    const point = middles.length ? [0, 1, 2].map((k) => middles.reduce((sum, m) => sum + m[k], 0) / middles.length) : this.page.target;
    return { point, normal };
  }

  // Choosing ------------------------------------------------------------------------------------------

  choose(i, fly = true) {
    this.chosen = i;
    const isSkin = this.site.kind === "skin";
    if (isSkin) this.showPart("skin", 1);
    else {
      if (this.opacity.skin > SEEN) this.showPart("skin", FAINT);
      if (this.opacity[this.site.part] < SEEN) this.showPart(this.site.part, 1);
    }
    if (fly) this.fly();
    this.changed();
    this.panel.list.querySelector('[aria-pressed="true"]')?.scrollIntoView({ block: "nearest" });
  }

  choosePartner() { if (this.partner !== null) this.choose(this.partner); }

  /** The next (1) or the previous (−1) site to check; with none left, of all. */
  step(way) {
    const open = this.toCheck();
    const list = open.length ? open : this.order;
    const later = list.filter((i) => (way > 0 ? i > this.chosen : i < this.chosen));
    this.choose(way > 0 ? later[0] ?? list[0] : later.at(-1) ?? list.at(-1));
  }

  showPart(part, value) {
    this.opacity[part] = value;
    const field = document.getElementById(`show-${part}`);
    if (field) field.value = value;
  }

  /** Moves the camera to the standard view of the chosen site. */
  fly() {
    const { camera } = this;
    const { view } = this.site;
    const from = { azimuth: camera.azimuth, elevation: camera.elevation, span: camera.span, target: [...camera.target] };
    const target = this.shown[this.chosen].point;
    const turn = ((view.azimuth - from.azimuth + 540) % 360) - 180;
    const still = globalThis.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const begun = performance.now();
    const flight = (this.flight = {});
    const on = () => {
      if (this.flight !== flight) return;
      const share = still ? 1 : Math.min(1, (performance.now() - begun) / FLIGHT_MS);
      const s = share * share * (3 - 2 * share);
      camera.look({ azimuth: from.azimuth + s * turn, elevation: from.elevation + s * (view.elevation - from.elevation) });
      camera.span = from.span * (view.span / from.span) ** s;
      camera.target = from.target.map((v, k) => v + s * (target[k] - v));
      this.redraw();
      if (share < 1) requestAnimationFrame(on);
      else this.flight = null;
    };
    on();
  }

  // Pointer and keys ------------------------------------------------------------------------------------

  get size() { return [this.overlay.clientWidth, this.overlay.clientHeight]; }

  /** What is seen at a place of the picture: the point, the surface; null where there is none. */
  seen(at, surfaces = this.surfaces.filter((s) => this.opacity[s.part] >= SEEN)) {
    const found = surfaces.flatMap((surface) => {
      const seen = seenPoint(this.camera, surface.places, surface.triangles, at, ...this.size);
      return seen ? [{ ...seen, surface }] : [];
    });
    return found.reduce((a, b) => (a && a.depth >= b.depth ? a : b), null);
  }

  isShown(i) {
    return this.page.sites[i].kind !== "skin" || this.opacity.skin >= SEEN || i === this.chosen;
  }

  /** The site whose ball is at a place of the picture; −1 where there is none. */
  ballAt(at) {
    const { towards } = this.camera.axes();
    const near = this.shown.flatMap(({ point }, i) => {
      if (!this.isShown(i)) return [];
      const [x, y] = this.camera.project(point, ...this.size);
      const away = Math.hypot(x - at[0], y - at[1]);
      return away <= GRAB ? [{ i, away }] : [];
    }).sort((a, b) => (b.i === this.chosen) - (a.i === this.chosen) || a.away - b.away);
    for (const { i } of near) {
      const { point } = this.shown[i];
      const depth = towards.reduce((sum, v, k) => sum + v * (point[k] - this.camera.target[k]), 0);
      const front = this.seen(this.camera.project(point, ...this.size));
      if (!front || front.depth <= depth + HIDES) return i;
    }
    return -1;
  }

  canGrab(at) { return this.ballAt(at) >= 0; }

  grab(at) {
    this.flight = null;
    const i = this.ballAt(at);
    if (i < 0) return null;
    if (i !== this.chosen) this.choose(i, false);
    const [x, y] = this.camera.project(this.shown[i].point, ...this.size);
    const grip = [x - at[0], y - at[1]];
    let moved = false;
    return {
      drag: (to) => {
        if (!moved && Math.hypot(to[0] - at[0], to[1] - at[1]) < 3) return;
        moved = true;
        const seen = this.seen([to[0] + grip[0], to[1] + grip[1]], this.surfaces.filter((s) => s.part === this.site.part));
        if (!seen) return;
        this.pending = new Map([...this.history.now, [i, { point: seen.point, origin: "placed" }]]);
        this.schedule();
      },
      release: () => {
        if (!this.pending) return;
        const placed = this.pending;
        this.decide(placed);
        this.placedReport(i);
      },
    };
  }

  /** A click places the chosen site, on the bone that it belongs to and on no other. */
  clicked(at) {
    const seen = this.seen(at);
    if (!seen) return;
    const { site } = this;
    const { part } = seen.surface;
    if (part !== site.part) {
      const advice = part === "skin" ? _`make the skin fainter` : _`hide the ${part} if it is in front`;
      this.report(_`${site.label} lies on the ${site.part}, and this is the ${part}: click on the ${site.part} (${advice}).`);
      return;
    }
    this.put(this.chosen, seen.point);
    this.placedReport(this.chosen);
  }

  placedReport(i) {
    const { label, name } = this.page.sites[i];
    const point = this.shown[i].point;
    const other = this.partner === null ? null : this.shown[this.partner].point;
    const wrong = other && (name.endsWith("_L") ? point[0] < other[0] : point[0] > other[0]);
    this.report(wrong ? _`${label} is now on the other side of its partner: left is the patient's left. Undo with Ctrl+Z.` : _`${label} placed.`);
  }

  pressed(e) {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.type === "text") return;
    const onButton = e.target.tagName === "BUTTON" && !e.target.dataset.site;
    const actions = {
      n: () => this.step(1), p: () => this.step(-1), x: () => this.choosePartner(), m: () => this.mirror(),
      Delete: () => this.remove(), Backspace: () => this.remove(),
      ...(onButton ? {} : { Enter: () => this.accept() }),
    };
    const action = actions[e.key.length === 1 ? e.key.toLowerCase() : e.key];
    if (!action) return;
    action();
    e.preventDefault();
  }

  // What is shown -----------------------------------------------------------------------------------------

  report(text) {
    const box = document.getElementById("message");
    box.textContent = text;
    clearTimeout(this.messageTimer);
    this.messageTimer = setTimeout(() => { box.textContent = ""; }, MESSAGE_MS);
  }

  showState() {
    const box = document.getElementById("error-state");
    const toCheck = this.toCheck();
    const open = toCheck.length;
    const done = this.decided.size;
    const next = this.model.mostUseful([...this.decided.keys()].sort((a, b) => a - b), toCheck);
    const hint = open > 1 ? _` ${this.page.sites[next].label} would help the others most.` : "";
    box.textContent = open
      ? _`${open} of ${this.page.sites.length} sites to check; ${done} placed or accepted.${hint}`
      : _`Nothing is left to check; ${done} of ${this.page.sites.length} sites placed or accepted.`;
    box.classList.toggle("warning", open > 0);
  }

  /** Computes the sites that follow a drag, once for each picture. */
  schedule() {
    this.stale = true;
    this.redraw();
  }

  redraw() {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      if (this.stale) {
        this.stale = false;
        this.shown = this.derived(this.decided);
        this.panel.showCard();
      }
      this.draw();
    });
  }

  parts() {
    const colours = { cranium: STILL_BONE, mandible: JAW, skin: SKIN };
    const bones = this.surfaces.map(({ part, drawn }) => ({ surface: drawn, colour: colours[part], opacity: this.opacity[part], motion: STAYS }));
    const balls = this.shown.flatMap(({ state, point }, i) => (this.isShown(i) ? [{
      surface: this.ball, colour: rgb(STATES[state].colour), opacity: state === "missing" ? 0.5 : 1,
      motion: ballMotion(point, ballRadius(this.camera, i === this.chosen)),
    }] : []));
    // Bones and balls first: what is seen through is drawn over them.
    return [...balls, ...bones];
  }

  draw() {
    this.drawing.fit();
    this.drawing.clear(BACKGROUND);
    this.drawing.draw(this.camera, this.parts());
    this.mark();
  }

  /** A ring and the name at the chosen site. */
  mark() {
    const { pen, width, height } = cleared(this.overlay);
    const { point } = this.shown[this.chosen];
    const [x, y] = this.camera.project(point, width, height);
    const radius = (ballRadius(this.camera, true) * height) / this.camera.span + 6;
    pen.lineWidth = 4;
    pen.strokeStyle = "#ffffffcc";
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.stroke();
    pen.lineWidth = 2;
    pen.strokeStyle = "#1d2530";
    pen.stroke();
    const text = this.site.label;
    pen.font = "600 14px system-ui, sans-serif";
    const wide = pen.measureText(text).width;
    const left = x + radius + 8 + wide > width ? x - radius - 14 - wide : x + radius + 4;
    pen.fillStyle = "#ffffffd9";
    pen.fillRect(left, y - 12, wide + 10, 24);
    pen.fillStyle = "#1d2530";
    pen.fillText(text, left + 5, y + 5);
  }
}

/** "gonion_L" as "Gonion, left". */
function labelOf(name) {
  const side = { L: ", left", R: ", right" }[/_([LR])$/.exec(name)?.[1]] ?? "";
  const plain = name.replace(/_[LR]$/, "").replaceAll("_", " ").replace(/\bm2$/, "M2");
  return plain[0].toUpperCase() + plain.slice(1) + side;
}

function mirrored(point, { point: middle, normal }) {
  const away = normal.reduce((sum, v, k) => sum + v * (point[k] - middle[k]), 0);
  return point.map((v, k) => v - 2 * away * normal[k]);
}

await start(App);

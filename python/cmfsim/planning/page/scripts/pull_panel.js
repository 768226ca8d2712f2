// Pulling a point of the skin: in the picture, or by the movement that it should make.

import { _, button, element, numberField, signed, typedNumber } from "./elements.js";
import { seenPoint } from "./picking.js";
import { Pull, PulledPoint } from "./pulling.js";
import { STAYS } from "./rigid.js";

const MOST_WISH = 30;
// The movement of a point from where it was before the operation, with a surgeon's signs.
const WISHES = [
  { key: "forwards", label: _`Forwards, mm`, axis: 1, sign: -1 },
  { key: "up", label: _`Up, mm`, axis: 2, sign: 1 },
  { key: "left", label: _`To the left, mm`, axis: 0, sign: 1 },
];
const PICKED = "picked";

export class PullPanel {
  /** app gives: page, face, motions, camera, view, preview, commit, report, redraw. */
  constructor(app) {
    this.app = app;
    this.pull = null;
    this.point = null;
    const moving = app.page.segments.map((s) => s.reference.join() !== STAYS.join());
    this.follows = app.page.segments.map((s, i) => element("input", {
      type: "checkbox", id: `follows-${i}`, checked: moving[i] || !moving.includes(true),
    }));
    this.choice = element("select", { id: "pull-point", onchange: () => this.choose() });
    this.fields = Object.fromEntries(WISHES.map(({ key }) => [key, numberField({
      id: `wish-${key}`,
      onkeydown: (e) => { if (e.key === "Enter") this.typed(); },
    })]));
    this.state = element("p", { className: "note", id: "pull-state", role: "status" });
    this.root = element("div", {},
      element("h2", { textContent: _`Pull the skin` }),
      element("p", { className: "note", textContent: _`The selected segments follow, with the smallest change of the plan. To pull in the picture, switch on “Pull the skin” below it and drag a point of the face. To type a movement, choose a point here.` }),
      element("div", { className: "row", role: "group", "aria-label": _`Segments that follow` },
        ...app.page.segments.map((s, i) => element("label", {}, this.follows[i], ` ${s.label}`))),
      element("div", { className: "row" }, element("label", { for: "pull-point", textContent: _`Point` }), this.choice),
      element("div", { className: "row" }, ...WISHES.map(({ key, label }) => element("label", {}, `${label} `, this.fields[key]))),
      element("div", { className: "row" }, button(_`Pull`, () => this.typed(), { id: "pull-typed" })),
      this.state);
    this.fill();
  }

  fill() {
    const names = this.app.page.skin_sites.map(({ name }, i) => [String(i), name.replaceAll("_", " ")]);
    if (this.vertex !== undefined) names.push([PICKED, _`the point picked in the picture`]);
    this.choice.replaceChildren(...names.map(([value, textContent]) => element("option", { value, textContent })));
  }

  get following() {
    return this.follows.flatMap((box, i) => (box.checked ? [i] : []));
  }

  /** The point that the choice stands for. */
  chosen() {
    const { face } = this.app;
    if (this.choice.value === PICKED) {
      return new PulledPoint(face, face.face, this.vertex, face.before.slice(3 * this.vertex, 3 * this.vertex + 3));
    }
    const i = Number(this.choice.value);
    return new PulledPoint(face, face.sites, i, face.siteBefore.slice(3 * i, 3 * i + 3));
  }

  choose() {
    this.point = this.chosen();
    this.show();
    this.app.redraw();
  }

  /** Begins a pull from the plan that is shown; null, with the reason reported, where none can be. */
  begin() {
    const { app } = this;
    if (!this.following.length) {
      app.report(_`No segment follows: select one under “Pull the skin”.`);
      return null;
    }
    const pull = new Pull(this.point, app.page.segments, app.motions, this.following);
    if (pull.moves) return pull;
    app.report(_`The selected segments do not move this point: choose another point or other segments.`);
    return null;
  }

  /** Picks the point of the skin at a place of the picture and begins to pull it. */
  grab(at) {
    const { app } = this;
    const { face, camera, overlay } = app;
    const seen = seenPoint(camera, app.shownPlaces, face.triangles, at, overlay.clientWidth, overlay.clientHeight);
    if (!seen) return false;
    this.vertex = seen.vertex;
    this.fill();
    this.choice.value = PICKED;
    this.point = this.chosen();
    this.pull = this.begin();
    this.from = at;
    this.goal = null;
    this.show();
    return this.pull !== null;
  }

  /** The picture's place was dragged to (x, y): in the plane of the picture. */
  drag([x, y]) {
    const { camera, overlay } = this.app;
    const { right, up } = camera.axes();
    const scale = camera.span / overlay.clientHeight;
    const [dx, dy] = [scale * (x - this.from[0]), -scale * (y - this.from[1])];
    this.goal = this.pull.from.map((v, k) => v + dx * right[k] + dy * up[k]);
    this.app.previewMotions(this.pull.towards(this.goal));
  }

  release() {
    this.pull = null;
    this.keep();
  }

  /** Keeps the plan that the pull has led to, and its goal with it. */
  keep() {
    this.app.commit();
    this.kept = this.app.motions;
  }

  /** Pulls the chosen point by the numbers that were typed. */
  typed() {
    this.point ??= this.chosen();
    const wish = [0, 0, 0];
    for (const { key, axis, sign } of WISHES) {
      const value = typedNumber(this.fields[key].value);
      if (!Number.isFinite(value) || Math.abs(value) > MOST_WISH) {
        this.app.report(_`Type three numbers of at most ${MOST_WISH} mm; the plan was not changed.`);
        return;
      }
      wish[axis] = sign * value;
    }
    const pull = this.begin();
    if (!pull) return;
    this.goal = this.point.before.map((v, k) => v + wish[k]);
    this.app.previewMotions(pull.towards(this.goal));
    this.keep();
  }

  /** What the point does under the plan that is shown. */
  show() {
    if (!this.point) return;
    // The goal belongs to the plan that it led to.
    if (!this.pull && this.app.motions !== this.kept) this.goal = null;
    const place = this.point.place(this.app.motions);
    const numbers = WISHES.map(({ axis, sign }) => sign * (place[axis] - this.point.before[axis]));
    WISHES.forEach(({ key }, i) => {
      const { fields } = this;
      if (document.activeElement !== fields[key]) fields[key].value = (numbers[i] + 0).toFixed(1).replace(/^-0\.0$/, "0.0");
    });
    const moved = WISHES.map(({ key }, i) => `${signed(numbers[i])} ${key}`).join(", ");
    const away = this.goal && Math.hypot(...place.map((v, k) => v - this.goal[k]));
    this.state.textContent = _`The point moves by ${moved} (mm).` +
      (away === null || away === undefined || away < 0.1 ? "" : _` It is still ${away.toFixed(1)} mm from the position to which it was pulled.`);
  }

  /** Marks the point, and the way to its goal, in the picture. */
  draw(pen, camera, width, height) {
    if (!this.point) return;
    const at = camera.project(this.point.place(this.app.motions), width, height);
    pen.strokeStyle = "#1d2530";
    pen.fillStyle = "#ffffff";
    pen.lineWidth = 2;
    if (this.goal) {
      pen.beginPath();
      pen.moveTo(...at);
      pen.lineTo(...camera.project(this.goal, width, height));
      pen.stroke();
    }
    pen.beginPath();
    pen.arc(...at, 6, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }
}

// The chosen site with its definition and a picture, and the list of all sites, doubtful ones first.

import { Camera } from "./camera.js";
import { STATES, ballMotion, unitBall } from "./balls.js";
import { SKIN, STILL_BONE, rgb } from "./colours.js";
import { Drawing } from "./drawing.js";
import { _, button, element } from "./elements.js";
import { STAYS } from "./rigid.js";

const GROUPS = [
  { key: "check", title: _`To check`, states: ["missing", "doubtful"] },
  { key: "rest", title: _`Proposed without doubt`, states: ["filled", "moved", "proposed"] },
  { key: "done", title: _`Placed or accepted`, states: ["placed", "accepted"] },
];
const SMALL_BALL = 2.6;
const SMALL_SPAN = 1.25;

export class SitePanel {
  constructor(app) {
    this.app = app;
    this.title = element("h2", { id: "site-title" });
    this.state = element("p", { id: "site-state" });
    this.where = element("p", { id: "site-where" });
    this.canvas = element("canvas", { className: "small", id: "site-picture", role: "img", "aria-label": _`The site on an average head` });
    this.accepting = button(_`Accept`, () => app.accept(), { id: "accept", title: _`key Enter: it is right as it is` });
    this.removing = button(_`Remove`, () => app.remove(), { id: "remove", title: _`key Delete: back to what was proposed` });
    this.mirroring = button(_`Mirror`, () => app.mirror(), { id: "mirror", title: _`key M: place the other side at the mirror image` });
    this.other = button(_`Other side`, () => app.choosePartner(), { id: "other-side", title: _`key X` });
    this.card = element("div", { className: "card" },
      this.title, this.state,
      element("div", { className: "where" }, this.where,
        element("figure", {}, this.canvas, element("figcaption", { textContent: _`On an average head` }))),
      element("div", { className: "row" }, this.accepting, this.removing, this.other, this.mirroring),
      element("div", { className: "row" },
        button(_`◀ Previous`, () => app.step(-1), { id: "previous", title: _`key P` }),
        button(_`Next to check ▶`, () => app.step(1), { id: "next", title: _`key N` }),
        button(_`Undo`, () => app.undo(), { id: "undo", title: _`Ctrl+Z` }),
        button(_`Redo`, () => app.redo(), { id: "redo", title: _`Ctrl+Shift+Z` })));
    this.list = element("div", { id: "sites" });
    this.root = element("div", {}, this.card, this.list);
    const { average } = app.page;
    this.drawing = new Drawing(this.canvas, [[0, 0, 0], [1, 1, 1]]);
    this.surfaces = average.surfaces.map(({ part }, i) => ({
      part, surface: this.drawing.surface(app.arrays[`average_${i}`].values, app.arrays[`average_${i}_triangles`].values),
    }));
    const ball = unitBall();
    this.ball = this.drawing.surface(ball.places, ball.triangles);
  }

  show() {
    this.showCard();
    this.showList();
  }

  showCard() {
    const { app } = this;
    const site = app.site;
    const shown = app.shown[app.chosen];
    this.title.textContent = site.label;
    this.state.className = `status ${shown.state}`;
    this.state.textContent = stateText(site, shown);
    this.where.replaceChildren(
      element("span", { textContent: site.where[0].toUpperCase() + site.where.slice(1) + "." }),
      element("span", { className: "note", textContent: _`Lies on the ${site.part === "skin" ? "skin" : site.part}${site.short ? _`; also called ${site.short}` : ""}.` }));
    this.accepting.disabled = shown.state === "placed" || shown.state === "accepted" || !shown.onSurface;
    this.removing.disabled = !app.decided.has(app.chosen);
    this.other.hidden = this.mirroring.hidden = app.partner === null;
    this.mirroring.disabled = !app.decided.has(app.chosen);
    this.drawAverage();
  }

  drawAverage() {
    const { app, drawing } = this;
    const { kind, name, view } = app.site;
    const point = app.page.average.points[kind][name];
    const camera = new Camera(point, SMALL_SPAN * view.span);
    camera.look(view);
    drawing.fit();
    drawing.clear([0.933, 0.945, 0.961]);
    const parts = this.surfaces.filter(({ part }) => (kind === "skin") === (part === "skin")).map(({ part, surface }) =>
      ({ surface, colour: part === "skin" ? SKIN : STILL_BONE, opacity: 1, motion: STAYS }));
    drawing.draw(camera, [...parts, { surface: this.ball, colour: rgb("#d55e00"), opacity: 1, motion: ballMotion(point, SMALL_BALL) }]);
  }

  showList() {
    const { app } = this;
    const focused = document.activeElement?.dataset?.site;
    this.list.replaceChildren(...GROUPS.flatMap(({ key, title, states }) => {
      const members = app.order.filter((i) => states.includes(app.shown[i].state));
      if (!members.length && key !== "check") return [];
      const head = element("h2", { textContent: `${title} (${members.length})`, id: `group-${key}` });
      if (!members.length) return [head, element("p", { className: "note", textContent: _`Nothing is left to check: save the files.` })];
      return [head, element("div", { className: "sites", role: "group", "aria-labelledby": `group-${key}` }, ...members.map((i) => this.row(i)))];
    }));
    if (focused !== undefined) this.list.querySelector(`[data-site="${focused}"]`)?.focus();
  }

  row(i) {
    const { app } = this;
    const site = app.page.sites[i];
    const { state, error } = app.shown[i];
    const dot = element("span", { className: `dot ${state}` });
    const what = state === "placed" || state === "accepted" ? STATES[state].label : _`${STATES[state].label}, ±${error.toFixed(1)} mm`;
    return element("button", {
      type: "button", className: "site", "aria-pressed": String(i === app.chosen), "data-site": i,
      onclick: () => app.choose(i),
    }, dot, element("span", { className: "name", textContent: site.label }), element("span", { className: "what", textContent: what }));
  }
}

/** The state of a site in a sentence. */
function stateText(site, { state, error, moved, onSurface }) {
  const near = _`expected error ${error.toFixed(1)} mm`;
  if (state === "placed") return _`Placed by hand.`;
  if (state === "accepted") return _`Accepted as it was proposed.`;
  if (state === "missing") {
    return _`Missing: ${site.why || _`it was not found`}. The pale ball is where the other sites put it (${near})${onSurface ? "" : _`, away from the surface`}: click on the bone to place it.`;
  }
  if (state === "filled") return _`Filled in from the sites that were placed (${near}). It was missing: ${site.why}.`;
  if (state === "moved") return _`Moved by ${moved.toFixed(1)} mm with the sites that were placed (${near} now). It was doubtful: ${site.doubt}.`;
  if (state === "doubtful") return _`Doubtful: ${site.doubt} (${near}). Place it, or accept it if it is right.`;
  return _`Proposed without doubt (${near})${moved >= 0.1 ? _`; moved by ${moved.toFixed(1)} mm with the sites that were placed` : ""}.`;
}

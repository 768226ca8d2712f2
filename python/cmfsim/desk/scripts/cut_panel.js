// The choice of procedures with their options, and the first moves of what they cut.

import { call } from "./desk_calls.js";
import { _, element, numberField, typedNumber } from "./elements.js";
import { History } from "./history.js";

const NAMES = { le_fort_1: _`Le Fort I`, le_fort_3: _`Le Fort III`, bsso: _`Sagittal split of both rami (BSSO)`, genioplasty: _`Genioplasty` };
const ANGLES = ["tilt", "cant", "angle"];
const STAYING = ["ramus_left", "ramus_right"];
const SENSES = ["forwards", "up", "left"];
const MOST = 30;

const words = (name) => name.replaceAll("_", " ");
const tenth = (value) => Math.round(10 * value) / 10;

export class CutPanel {
  /** app gives: page, planes, colour(pieces), redraw(), work. */
  constructor(app) {
    this.app = app;
    this.history = new History(structuredClone(app.page.cuts));
    this.cuts = this.history.now;
    this.typed = structuredClone(app.page.moves);
    this.boxes = {};
    this.fields = {};
    this.notes = element("div", { id: "cut-notes", role: "status" });
    this.rows = element("div", { className: "moves", id: "moves" });
    this.root = element("section", { className: "step", "aria-label": _`Procedures` },
      element("h2", { textContent: _`2. Procedures` }),
      ...app.page.procedures.map((p) => this.procedure(p)),
      this.notes,
      element("h2", { textContent: _`First moves, mm` }),
      element("p", { className: "note", textContent: _`The face is computed exactly for these; turns are added on the page of the plan. Left is the patient's left; negative numbers go the other way.` }),
      this.rows);
  }

  procedure({ kind, options, words: stated }) {
    const box = element("input", { type: "checkbox", id: `cut-${kind}`, onchange: () => this.choose(kind, box.checked) });
    this.boxes[kind] = box;
    const rows = Object.entries(options).flatMap(([name, [, low, high]]) => this.option(kind, name, low, high, stated[name]));
    const more = element("div", { className: "numbers options", hidden: true }, ...rows);
    this.fields[kind].more = more;
    return element("div", {}, element("div", { className: "choice" }, box, element("label", { for: `cut-${kind}`, textContent: NAMES[kind] ?? words(kind) })), more);
  }

  option(kind, name, low, high, stated) {
    const unit = ANGLES.includes(name) ? "°" : kind === "le_fort_3" && name === "arch" ? "share" : "mm";
    const step = high - low <= 2 ? 0.05 : 0.5;
    const id = `option-${kind}-${name}`;
    const label = `${stated}, ${unit}`;
    const field = numberField({ id, title: _`${name} in the case file: ${low} to ${high} ${unit}`, onchange: () => this.set(kind, name, typedNumber(field.value), true) });
    const slide = element("input", {
      type: "range", min: low, max: high, step, "aria-label": label,
      oninput: () => this.set(kind, name, Number(slide.value)), onchange: () => this.keep(),
    });
    this.fields[kind] ??= { options: {} };
    this.fields[kind].options[name] = { field, slide, low, high, step };
    return [element("label", { for: id, textContent: label }), field, slide];
  }

  defaultOf(kind, name) {
    return this.app.page.procedures.find((p) => p.kind === kind).options[name][0];
  }

  value(kind, name) { return this.cuts[kind]?.[name] ?? this.defaultOf(kind, name); }

  choose(kind, chosen) {
    const cuts = { ...this.cuts };
    if (chosen) cuts[kind] = {};
    else delete cuts[kind];
    this.cuts = cuts;
    this.keep();
  }

  /** Sets an option within its range, as far as it is a number. */
  set(kind, name, value, keep = false) {
    const { low, high, step } = this.fields[kind].options[name];
    if (!Number.isFinite(value)) this.app.work.fail(_`Type a number from ${low} to ${high}; nothing was changed.`);
    else {
      const digits = step < 0.1 ? 100 : 10;
      const within = Math.min(high, Math.max(low, Math.round(digits * value) / digits));
      if (keep && within !== Math.round(digits * value) / digits) this.app.work.fail(_`${words(name)} goes from ${low} to ${high}: ${within} is used.`);
      this.cuts = { ...this.cuts, [kind]: { ...this.cuts[kind], [name]: within } };
    }
    if (keep) this.keep();
    else this.changed();
  }

  keep() {
    if (this.cuts !== this.history.now) this.history.take(this.cuts);
    this.changed();
  }

  undo() { if (this.history.undo()) this.restored(); }
  redo() { if (this.history.redo()) this.restored(); }
  restored() {
    this.cuts = this.history.now;
    this.changed();
  }

  changed() {
    for (const [kind, { more, options }] of Object.entries(this.fields)) {
      this.boxes[kind].checked = kind in this.cuts;
      more.hidden = !(kind in this.cuts);
      for (const [name, { field, slide }] of Object.entries(options)) {
        const value = this.value(kind, name);
        field.value = String(value);
        slide.value = String(value);
      }
    }
    this.showMoves({});
    this.preview();
  }

  /** Asks for the planes of what is chosen; one question at a time, the last one counts. */
  async preview() {
    if (this.asking) {
      this.stale = true;
      return;
    }
    this.asking = true;
    try {
      const { planes, pieces, handles, problems } = await call("cuts", { cuts: this.cuts });
      this.app.planes.show(planes, handles);
      this.showMoves(this.app.colour(pieces));
      this.notes.replaceChildren(...problems.map((text) => element("p", { className: "finding", textContent: text })));
    } catch (error) {
      this.notes.replaceChildren(element("p", { className: "finding", textContent: error.message }));
    }
    this.asking = false;
    this.app.timing = 1;
    if (this.stale) {
      this.stale = false;
      this.preview();
    }
  }

  get segments() {
    const { procedures, moves, kept } = this.app.page;
    const cut = procedures.filter(({ kind }) => kind in this.cuts).flatMap(({ segments }) => segments);
    const all = procedures.flatMap(({ segments }) => segments);
    const own = [...Object.keys(moves), ...kept].filter((name) => !all.includes(name));
    return [...new Set([...cut, ...own])].filter((name) => !STAYING.includes(name));
  }

  showMoves(colours) {
    const key = this.segments.join();
    if (key !== this.shownSegments) {
      this.shownSegments = key;
      this.swatches = {};
      this.rows.replaceChildren(...(key ? [element("span"), ...SENSES.map((textContent) => element("span", { className: "note", textContent }))] : []),
        ...this.segments.flatMap((name) => this.moveRow(name)));
    }
    for (const [name, colour] of Object.entries(colours)) {
      // Set by script: the policy of the page allows no style in its elements.
      if (this.swatches[name]) this.swatches[name].style.background = `rgb(${colour.map((v) => Math.round(255 * v)).join(",")})`;
    }
  }

  moveRow(name) {
    this.swatches[name] = element("span", { className: "swatch" });
    const label = element("span", { className: "choice" }, this.swatches[name], words(name));
    if (this.app.page.kept.includes(name)) return [label, element("span", { className: "note", textContent: _`moves as the case file states` }), element("span"), element("span")];
    this.typed[name] ??= [0, 0, 0];
    return [label, ...SENSES.map((sense, k) => numberField({
      id: `move-${name}-${sense}`, "aria-label": _`${words(name)}: ${sense}, mm`, value: String(tenth(this.typed[name][k])),
      onchange: (e) => { this.typed[name][k] = typedNumber(e.target.value); },
    }))];
  }

  /** The first moves by segment, or what is wrong with them. */
  moves() {
    const moves = {};
    for (const name of this.segments.filter((n) => !this.app.page.kept.includes(n))) {
      const wrong = this.typed[name].findIndex((v) => !(Math.abs(v) <= MOST));
      if (wrong >= 0) return _`${words(name)}, ${SENSES[wrong]}: type a number from -${MOST} to ${MOST} mm. Nothing was saved.`;
      moves[name] = this.typed[name];
    }
    return moves;
  }
}

// The desk: the head with the planes of its cuts, and the steps to a plan.

import { Camera } from "./camera.js";
import { SKIN, STILL_BONE, rgb } from "./colours.js";
import { CutPanel } from "./cut_panel.js";
import { WorkView, call, findingList } from "./desk_calls.js";
import { Drawing } from "./drawing.js";
import { _, button, element } from "./elements.js";
import { PlaneView } from "./plane_view.js";
import { connectKeys, connectPointing } from "./pointing.js";
import { questionStep } from "./questions.js";
import { STAYS } from "./rigid.js";
import { unpack } from "./unpacking.js";
import { addViews, slider } from "./view_panel.js";

const BACKGROUND = [0.933, 0.945, 0.961];
class App {
  constructor(page, arrays) {
    this.page = page;
    this.seen = null;
    this.overlay = document.getElementById("overlay");
    this.opacity = { bones: 1, skin: 0.15 };
    // The bone that stays, then a colour for each piece.
    this.colours = [STILL_BONE, ...Object.values(page.colours).map(rgb)];
    this.drawing = new Drawing(document.getElementById("drawing"), this.colours);
    this.camera = new Camera(page.target ?? [0, 0, 0], page.span ?? 200);
    this.surfaces = page.surfaces.map(({ name, part }, i) => {
      const [places, triangles] = [arrays[`surface_${i}`].values, arrays[`surface_${i}_triangles`].values];
      return { name, part, places, drawn: this.drawing.surface(places, triangles), amounts: new Float32Array(places.length / 3) };
    });
    this.isOpen = this.surfaces.length > 0;
    this.planes = new PlaneView(this);
    this.work = new WorkView((state, ran) => this.shown(state, ran));
    this.build();
    this.work.watch();
  }

  build() {
    const { page } = this;
    const panel = document.getElementById("panel");
    panel.append(this.work.root);
    if (page.error) this.work.fail(page.error);
    if (page.questions.length) panel.append(questionStep(page.questions, (question, toml) => this.answer(question, toml)));
    if (page.taken.length) {
      panel.append(element("details", {}, element("summary", { textContent: _`What the files were taken for` }),
        ...page.taken.map((t) => element("p", { className: "note", textContent: `${t.file}: ${t.taken_for || "?"} (${t.why})` }))));
    }
    if (this.isOpen) {
      addViews(this, _`Whole head`);
      document.getElementById("controls").append(
        ...[["bones", "Bones"], ["skin", "Skin"]].map(([key, label]) => slider(`show-${key}`, label, this.opacity[key], (v) => { this.opacity[key] = v; this.redraw(); })),
        element("span", { className: "note", textContent: _`Drag to rotate, Shift-drag to move, wheel to zoom. Drag a round handle to move its plane.` }));
      this.cutting = new CutPanel(this);
      panel.append(this.landmarkStep(), this.cutting.root, this.planStep());
      connectPointing(this);
      connectKeys(this);
      new ResizeObserver(() => this.redraw()).observe(this.overlay);
      this.cutting.changed();
    } else if (!page.questions.length) {
      panel.append(button(_`Open the head`, () => this.begin("open"), { id: "open", hidden: true }));
    }
    this.redraw();
    panel.append(this.findings = element("div"));
  }

  landmarkStep() {
    const { sites } = this.page;
    const open = sites.filter((s) => !s.placed && (s.doubt || s.why));
    const placed = sites.filter((s) => s.placed).length;
    const text = open.length
      ? _`${open.length} of ${sites.length} sites ${open.length === 1 ? "is" : "are"} doubtful or missing: ${open.slice(0, 4).map((s) => s.name).join(", ")}${open.length > 4 ? ", …" : ""}. Cuts and muscles are placed by them: check these first.`
      : _`${sites.length} sites, none of them doubtful; ${placed} placed or accepted.`;
    return element("section", { className: "step", "aria-label": _`Landmarks` },
      element("h2", { textContent: _`1. Landmarks` }),
      element("p", { className: open.length ? "state warning" : "state", id: "site-note", textContent: text }),
      element("a", { href: "landmarks", id: "to-landmarks", textContent: _`Check the landmarks` }));
  }

  planStep() {
    this.computing = button(_`Save, and compute the plan`, () => this.compute(), { id: "compute", className: "main-action" });
    this.link = element("a", { href: "plan", id: "to-plan", textContent: _`Plan the moves, predict and print`, hidden: true });
    return element("section", { className: "step", "aria-label": _`Plan` },
      element("h2", { textContent: _`3. Plan` }),
      element("p", { className: "note", textContent: _`Saves cuts and moves in ${this.page.case_file}, builds the face, and opens the page on which it follows the bones.` }),
      element("div", { className: "row" }, this.computing, this.link));
  }

  // The server -----------------------------------------------------------------------------------

  shown(state, ran) {
    this.seen ??= state.seen;
    this.findings.replaceChildren(findingList(state.findings));
    // What has been read since this page was made is on the next one.
    if (ran && this.wants === "plan" && state.planned) { globalThis.location.assign("plan"); return; }
    if (ran && !state.error && !this.isOpen) { globalThis.location.reload(); return; }
    if (state.is_open && !this.isOpen) { globalThis.location.reload(); return; }
    this.wants = null;
    if (this.isOpen) {
      this.computing.disabled = false;
      this.link.hidden = !state.planned;
    }
    const again = document.getElementById("open");
    if (again) again.hidden = false;
  }

  async begin(name, values = {}) {
    try {
      const state = await call(name, values);
      this.seen = state.seen;
      await this.work.watch(true);
    } catch (error) {
      this.wants = null;
      if (this.computing) this.computing.disabled = false;
      this.work.fail(`${error.message}.`);
    }
  }

  async answer({ line }, toml) {
    try {
      await call("answer", { seen: this.seen, line, toml });
      globalThis.location.reload();
    } catch (error) {
      this.work.fail(_`Not saved: ${error.message}.`);
    }
  }

  compute() {
    const moves = this.cutting.moves();
    if (typeof moves === "string") {
      this.work.fail(moves);
      return;
    }
    this.computing.disabled = true;
    this.wants = "plan";
    this.begin("compute", { seen: this.seen, cuts: this.cutting.cuts, moves });
  }

  // The picture ------------------------------------------------------------------------------------

  undo() { this.cutting.undo(); }
  redo() { this.cutting.redo(); }
  canGrab(at) { return this.planes.points(at); }
  grab(at) { return this.planes.grab(at); }

  redraw() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.draw();
    });
  }

  draw() {
    const bones = this.surfaces.filter(({ part }) => part !== "skin").map(({ drawn }) => ({ surface: drawn, colour: STILL_BONE, opacity: this.opacity.bones, motion: STAYS, scale: 1 }));
    const skin = this.surfaces.filter(({ part }) => part === "skin").map(({ drawn }) => ({ surface: drawn, colour: SKIN, opacity: this.opacity.skin, motion: STAYS }));
    this.drawing.fit();
    this.drawing.clear(BACKGROUND);
    this.drawing.draw(this.camera, [...bones, ...this.planes.parts(), ...skin]);
    this.planes.mark();
  }

  /** Colours the bones by the pieces that the planes make of them. */
  colour(pieces) {
    const known = Object.keys(this.page.colours);
    const names = [...new Set(pieces.flatMap(({ name, rest }) => [name, rest]))].filter((n) => !this.page.bones.includes(n));
    const place = (name) => (names.includes(name) ? known.indexOf(name) + 1 : 0);
    const share = (name) => (place(name) + 0.5) / this.colours.length;
    for (const { name, part, places, amounts, drawn } of this.surfaces) {
      if (part === "skin") continue;
      const own = pieces.filter((piece) => piece.part === name);
      for (let i = 0; i < amounts.length; i++) {
        let bone = name;
        for (const piece of own) {
          const within = ([x, y, z, d]) => x * places[3 * i] + y * places[3 * i + 1] + z * places[3 * i + 2] + d >= 0;
          if (bone !== name && !own.some((p) => p.rest === bone)) break;
          if (piece.groups.some((planes) => planes.every(within))) bone = piece.name;
          else if (piece.rest !== piece.part) bone = piece.rest;
        }
        amounts[i] = share(bone);
      }
      this.drawing.recolour(drawn, amounts);
    }
    this.redraw();
    return Object.fromEntries(names.map((name) => [name, this.colours[place(name)]]));
  }
}

try {
  const page = JSON.parse(document.getElementById("page-values").textContent);
  const arrays = await unpack(document.getElementById("page-numbers").textContent, page.arrays);
  // For the console, and for tests.
  globalThis.cmfsimDesk = new App(page, arrays);
} catch (error) {
  const box = document.getElementById("failure");
  box.textContent = _`The desk cannot be shown: ${error.message}`;
  box.hidden = false;
  throw error;
}

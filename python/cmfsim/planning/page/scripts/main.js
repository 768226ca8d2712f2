// The page: one plan at a time, its face computed by the operator, and everything that shows it.

import { BandPanel } from "./band_panel.js";
import { Camera } from "./camera.js";
import { SKIN, STILL_BONE, mapped, rgb } from "./colours.js";
import { DeskPanel } from "./desk_panel.js";
import { Drawing, vertexNormals } from "./drawing.js";
import { _, element } from "./elements.js";
import { ExportPanel } from "./export_panel.js";
import { fileName, save } from "./exporting.js";
import { Handles } from "./handles.js";
import { MeasurePanel } from "./measure_panel.js";
import { Ruler } from "./measuring.js";
import { Mirror } from "./mirroring.js";
import { PatientFace } from "./model.js";
import { ExactSolver } from "./serving.js";
import { PlanPanel } from "./plan_panel.js";
import { PullPanel } from "./pull_panel.js";
import { NUMBERS, clinicalNumbers } from "./clinical.js";
import { Plans, beyondLimits } from "./plans.js";
import { connectKeys, connectPointing } from "./pointing.js";
import { ProfilePhoto, drawProfile, variantColour } from "./profile.js";
import { STAYS, movedAll, partOf } from "./rigid.js";
import { start } from "./unpacking.js";
import { VariantPanel } from "./variant_panel.js";
import { ViewPanel } from "./view_panel.js";

// Deeper than this, and deeper than before, mm, teeth pass through each other.
const TEETH_TOLERANCE = 0.3;
// A plan this near to the case's own, mm, is the case's own.
const SAME_PLAN = 1e-6;
const WARNED_ERROR = 0.5;
const MESSAGE_MS = 6000;
const BACKGROUND = [0.933, 0.945, 0.961];

class App {
  constructor(page, arrays) {
    this.page = page;
    this.face = new PatientFace(page, arrays);
    this.plans = new Plans(this.face.reference, page.variants);
    this.pending = null;
    this.settled = true;
    // Milliseconds of the last face, and of its normals.
    this.timing = { compute: 0, normals: 0 };
    const { before, triangles } = this.face;
    this.shift = new Float32Array(before.length);
    this.after = Float32Array.from(before);
    this.shownPlaces = Float32Array.from(before);
    this.normals = new Float32Array(before.length);
    this.amounts = new Float32Array(before.length / 3);
    this.camera = new Camera(page.target, page.span);
    this.drawing = new Drawing(document.getElementById("drawing"), Array.from({ length: 64 }, (_, i) => mapped(i / 63)));
    this.overlay = document.getElementById("overlay");
    this.handles = new Handles(this.overlay);
    this.skin = this.drawing.surface(before, triangles);
    this.skinBefore = this.drawing.surface(before, triangles);
    this.bones = page.bones.map(({ segment, colour }, i) => ({
      segment, places: arrays[`bone_${i}`].values, triangles: arrays[`bone_${i}_triangles`].values,
      surface: this.drawing.surface(arrays[`bone_${i}`].values, arrays[`bone_${i}_triangles`].values),
      colour: segment === null ? STILL_BONE : rgb(colour),
    }));
    this.solver = new ExactSolver(this);
    this.build();
  }

  get motions() {
    return this.pending ?? this.plans.active.motions;
  }

  build() {
    this.view = new ViewPanel(this, ["side", "map", ...(this.face.band ? ["band"] : []), "handles", "pull"]);
    this.ruler = new Ruler(this, () => this.surfaces());
    this.mirror = new Mirror(this, this.page.midplane, () => {
      const places = this.face.sitePlaces(this.motions);
      return Object.fromEntries(this.page.skin_sites.map(({ name }) => [name, places[name]]));
    });
    this.panel = new PlanPanel(this);
    this.pulling = new PullPanel(this);
    this.variants = new VariantPanel(this);
    this.measuring = new MeasurePanel(this);
    this.trusting = new BandPanel(this);
    this.exporting = new ExportPanel(this);
    this.desk = new DeskPanel(this);
    this.profile = element("canvas", { className: "profile", role: "img", "aria-label": _`Midline profile` });
    this.profileNote = element("p", { className: "note" });
    this.photo = new ProfilePhoto(this);
    document.getElementById("panel").append(
      this.desk.root, this.panel.root, this.pulling.root, this.variants.root,
      element("div", {}, element("h2", { textContent: _`Midline profile` }), this.profile, this.profileNote, this.page.has_profile ? this.photo.root : null),
      this.measuring.root, this.trusting.root, this.exporting.root);
    connectPointing(this);
    connectKeys(this);
    new ResizeObserver(() => this.redraw()).observe(this.overlay);
    new ResizeObserver(() => this.showProfile()).observe(this.profile);
    this.changed();
  }

  // Changes of the plan -----------------------------------------------------------------------

  /** Shows another motion of a segment that is not kept yet. */
  preview({ segment, motion }) {
    this.previewMotions(this.plans.active.motions.map((m, i) => (i === segment ? motion : m)));
  }

  /** Shows a plan that is not kept yet. */
  previewMotions(motions) {
    this.pending = motions;
    this.settled = false;
    this.schedule("plan");
  }

  /** Keeps what is previewed. */
  commit() {
    const { pending } = this;
    this.pending = null;
    const was = this.plans.active.motions;
    if (pending?.some((motion, s) => motion.some((v, i) => v !== was[s][i]))) {
      this.plans.take(this.plans.withMotions(pending));
    }
    this.changed();
  }

  /** The case's own plan as the only variant; undo brings the others back. */
  reset() {
    this.plans.take({ active: 0, variants: [{ name: "A", motions: this.plans.reference }] });
    this.changed();
  }

  undo() { if (this.plans.undo()) this.changed(); }
  redo() { if (this.plans.redo()) this.changed(); }

  changed() {
    this.pending = null;
    this.settled = true;
    this.schedule("plan");
    this.solver.ask();
  }

  canGrab(at) {
    return this.handles.at(...at) !== null;
  }

  /** What a press at a place of the picture takes hold of: a handle, or a point of the skin. */
  grab(at) {
    const { handles, pulling } = this;
    const shape = handles.at(...at);
    if (shape) {
      handles.grab(shape, ...at);
      const { motion, place } = this.panel;
      const numbers = clinicalNumbers(motion, place);
      return {
        // To a tenth, as the fields show it.
        drag: (to) => this.panel.change(shape.key, Math.round(10 * (numbers[shape.key] + handles.pulled(...to))) / 10, false),
        release: () => { handles.release(); this.commit(); },
      };
    }
    if (!this.canPull) return null;
    pulling.grab(at);
    this.redraw();
    return pulling.pull && { drag: (to) => pulling.drag(to), release: () => pulling.release() };
  }

  load(motions, warning) {
    motions.forEach((motion, s) => {
      const why = beyondLimits(motion, STAYS, this.page.segments[s].points[0].place, NUMBERS);
      if (why) throw new Error(`${this.page.segments[s].label}: ${why}`);
    });
    this.plans.add(motions);
    this.report(warning || _`Loaded as a new variant.`);
    this.changed();
  }

  // What is shown -------------------------------------------------------------------------------

  report(text) {
    const box = document.getElementById("message");
    box.textContent = text;
    clearTimeout(this.messageTimer);
    this.messageTimer = setTimeout(() => { box.textContent = ""; }, MESSAGE_MS);
  }

  schedule(what) {
    this.work = this.work === "plan" ? "plan" : what;
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      const { work } = this;
      this.work = null;
      if (work === "plan") this.compute();
      if (work !== "view") this.place();
      this.draw();
    });
  }

  redraw() { this.schedule("view"); }
  reshow() { this.schedule("show"); }

  /** The face under the plan that is shown, and all that depends on it. */
  compute() {
    const begun = performance.now();
    const { before } = this.face;
    this.face.faceShift(this.shift, this.motions);
    for (let i = 0; i < before.length; i++) this.after[i] = before[i] + this.shift[i];
    this.timing.compute = performance.now() - begun;
    this.panel.show();
    this.pulling.show();
    this.measuring.show();
    this.trusting.show();
    this.mirror.show();
    this.exporting.show();
    this.desk.show();
    if (this.settled) this.variants.show();
    this.showError();
    this.showTeeth();
    this.showProfile();
  }

  /** Places, normals and colours of the skin for the picture. */
  place() {
    const { before, triangles } = this.face;
    const { share, map, band } = this.view.values;
    for (let i = 0; i < before.length; i++) this.shownPlaces[i] = before[i] + share * this.shift[i];
    const begun = performance.now();
    vertexNormals(this.normals, this.shownPlaces, triangles);
    this.timing.normals = performance.now() - begun;
    this.most = 1;
    if (map || band) {
      const { shift, amounts } = this;
      if (band) this.face.face.interpolate(amounts, this.face.band.halfWidths(this.motions));
      else for (let i = 0; i < amounts.length; i++) amounts[i] = Math.hypot(shift[3 * i], shift[3 * i + 1], shift[3 * i + 2]);
      this.most = Math.max(1, Math.ceil(2 * amounts.reduce((a, b) => Math.max(a, b), 0)) / 2);
    }
    this.drawing.update(this.skin, this.shownPlaces, this.normals, this.amounts);
    this.view.showLegend(this.most);
  }

  parts(before) {
    const { skin, bones, share, map, band } = this.view.values;
    const drawn = this.bones.map(({ segment, surface, colour }) => ({
      surface, colour, opacity: bones,
      motion: segment === null || before ? STAYS
        : share === 1 ? this.motions[segment]
        : partOf(this.motions[segment], share, this.page.segments[segment].centre),
    }));
    const scale = (map || band) && !before ? 1 / this.most : 0;
    return [...drawn, ...(before ? [] : this.mirror.parts(this.skin)), { surface: before ? this.skinBefore : this.skin, colour: SKIN, opacity: skin, motion: STAYS, scale }];
  }

  draw() {
    const { side, handles, share } = this.view.values;
    this.drawing.fit();
    this.drawing.clear(BACKGROUND);
    const after = share === 1 ? _`After: ${this.plans.active.name}` : share === 0 ? _`Before` : _`${Math.round(100 * share)} % of ${this.plans.active.name}`;
    if (side) {
      this.drawing.draw(this.camera, this.parts(true), 0, 0.5);
      this.drawing.draw(this.camera, this.parts(false), 0.5, 1);
    } else {
      this.drawing.draw(this.camera, this.parts(false));
    }
    document.getElementById("caption-left").textContent = side ? _`Before` : after;
    document.getElementById("caption-right").textContent = side ? after : "";
    // Handles stand where the segment is after the move, so only there; a point that is pulled lies
    // under them.
    const handled = handles && !side && share === 1 && !this.canPull;
    this.handles.draw(this.camera, handled ? this.panel.motion : null, this.panel.place, this.panel.turnsAbout);
    if (!side) this.ruler.draw(this.handles.context, this.camera, this.overlay.clientWidth, this.overlay.clientHeight);
    if (this.canPull) this.pulling.draw(this.handles.context, this.camera, this.overlay.clientWidth, this.overlay.clientHeight);
  }

  clicked(at) {
    if (!this.view.values.side) this.ruler.clicked(at);
  }

  /** What can be measured: skin and bones where they are drawn. */
  surfaces() {
    const { skin, bones } = this.view.values;
    const shown = this.parts(false);
    return [
      { places: this.shownPlaces, triangles: this.face.triangles, opacity: skin },
      ...this.bones.map(({ places, triangles }, i) => ({ places: movedAll(shown[i].motion, places), triangles, opacity: bones })),
    ];
  }

  /** Whether the picture shows the skin where the plan has it, so that it can be pulled. */
  get canPull() {
    const { pull, side, share, skin } = this.view.values;
    return pull && !side && share === 1 && skin > 0;
  }

  showError() {
    const box = document.getElementById("error-state");
    const { is_exact: isExact, reach_mm: reach, trials, left_out: leftOut } = this.page.expected_error;
    const distance = this.face.distance(this.motions);
    const found = this.face.expectedError(this.motions);
    let warned = false;
    if (this.face.isExact(this.motions)) {
      const { seconds, contact_converged: converged } = this.face.exact.figures;
      box.textContent = _`Solved exactly on this machine in ${seconds.toFixed(1)} s${converged ? "" : _`; contact stopped above its tolerance`}.`;
      warned = !converged;
    } else if (distance <= SAME_PLAN) box.textContent = _`The case's plan: this face was solved exactly.`;
    else if (isExact) box.textContent = _`In this model no tissue slides or is lifted off the bone: the face equals the exact solution (rounding 0.01 mm).`;
    else if (!found) {
      box.textContent = _`This plan is ${distance.toFixed(1)} mm from the case's own, farther than any plan that was tested (${reach.toFixed(1)} mm): the face may be wrong. Solve it exactly.`;
      warned = true;
    } else {
      const count = trials.filter((t) => !t.failed).length;
      const failed = trials.length - count;
      const corrected = leftOut.length ? _` and ${leftOut.length} left out of the correction one by one` : "";
      box.textContent = _`The face differs from this model's exact solution by ${found.mean.toFixed(2)} mm on average, at most ${found.usual.toFixed(2)} mm in nine of ten plans as far away, ${found.largest.toFixed(2)} mm in the worst; errors against real faces are millimetres (an estimate from exact solutions of ${count} other plans${corrected}; this plan is ${distance.toFixed(1)} mm from the case's own, where contact was solved).`;
      if (failed) box.textContent += _` ${failed} more could not be solved.`;
      warned = found.usual > WARNED_ERROR;
    }
    if (this.solver.state) box.textContent += ` ${this.solver.state}`;
    box.classList.toggle("warning", warned);
  }

  showTeeth() {
    const box = document.getElementById("teeth-state");
    const { occlusion, occlusion_absent: absent } = this.page;
    if (!occlusion) {
      box.textContent = _`The teeth are not checked: ${absent}`;
      return;
    }
    this.depthBefore ??= this.face.toothDepth(null);
    const depth = this.face.toothDepth(this.motions);
    const warned = depth > TEETH_TOLERANCE && depth > this.depthBefore + TEETH_TOLERANCE;
    box.textContent = warned
      ? _`Tooth rows overlap by ${depth.toFixed(1)} mm (before: ${this.depthBefore.toFixed(1)} mm).`
      : _`Tooth rows do not overlap more than before.`;
    box.classList.toggle("warning", warned);
  }

  showProfile() {
    const { variants, active } = this.plans.now;
    const { page, face } = this;
    if (!page.has_profile) {
      this.profileNote.textContent = _`No profile: ${page.profile_absent}`;
      return;
    }
    const lines = [{ points: face.profile(face.before), colour: "#7a8591", thick: 2, dash: [5, 4] }];
    if (this.settled) {
      // Other variants once the plan is kept: their faces cost a product each.
      const other = new Float32Array(face.before.length);
      this.otherProfiles = variants.map(({ motions }, i) => {
        if (i === active) return null;
        face.faceShift(other, motions);
        for (let k = 0; k < other.length; k++) other[k] += face.before[k];
        return { points: face.profile(other), colour: variantColour(i), thick: 1.5 };
      });
    }
    lines.push(...(this.otherProfiles ?? []).filter(Boolean));
    lines.push({ points: face.profile(this.after), colour: variantColour(active), thick: 2.5 });
    drawProfile(this.profile, lines);
    this.photo.show([{ ...lines[0], colour: "#1d2530" }, lines.at(-1)]);
    this.profileNote.textContent = _`Dashed: before. ${variants.map((v, i) => `${i === active ? "Thick" : "Thin"}: ${v.name}`).join("; ")}.`;
  }

  savePicture() {
    this.draw();
    const { drawing, page } = this;
    const picture = document.createElement("canvas");
    const band = 40;
    picture.width = drawing.width;
    picture.height = drawing.height + band;
    const pen = picture.getContext("2d");
    pen.fillStyle = "#fff";
    pen.fillRect(0, 0, picture.width, picture.height);
    pen.drawImage(drawing.canvas, 0, 0);
    pen.fillStyle = "#1d2530";
    pen.font = "16px system-ui, sans-serif";
    pen.fillText(_`${page.case}, variant ${this.plans.active.name}, model ${page.model}: predicted face. Not a medical device.`, 10, drawing.height + 26, picture.width - 20);
    picture.toBlob((blob) => save(`${fileName(page.case)}-${fileName(this.plans.active.name)}.png`, blob, "image/png"));
  }
}

await start(App);

// Files of landmarks: saved for the case, and loaded by the file picker or by dropping them.

import { call, deskState } from "./desk_calls.js";
import { _, button, copied, element } from "./elements.js";
import { save } from "./exporting.js";
import { decidedOf, sitesOf } from "./loading.js";
import { markupsOf, markupsText } from "./markups.js";

const KINDS = ["skull", "skin"];
const MOST_BYTES = 16_000_000;
// A site that nobody placed and that differs by this from where the page puts it was moved, mm.
const MOVED = 1;
const fileOf = (kind) => `${kind}_landmarks.mrk.json`;

export class FilesPanel {
  constructor(app) {
    this.app = app;
    this.file = element("input", { type: "file", accept: ".json", multiple: true, id: "landmark-files", onchange: () => this.loadAll([...this.file.files]) });
    const kinds = KINDS.filter((kind) => app.page.sites.some((s) => s.kind === kind));
    this.lines = ["[landmarks]", ...kinds.map((kind) => `${kind} = "${fileOf(kind)}"`), 'automatic = "missing"'].join("\n");
    this.kinds = kinds;
    this.root = element("div", {},
      element("h2", { textContent: _`Save` }),
      app.page.on_desk ? this.caseRow() : null,
      element("div", { className: "row" }, ...kinds.map((kind) =>
        button(_`Save the ${kind}`, () => this.save(kind), { id: `save-${kind}`, title: fileOf(kind) }))),
      this.note = element("p", { className: "note", id: "save-note" }),
      element("p", { className: "note", textContent: _`Put the files next to the case file, and these lines into it:` }),
      element("code", { textContent: this.lines, className: "lines" }),
      element("div", { className: "row" },
        button(_`Copy the lines`, async () => app.report((await copied(this.lines)) ? _`Copied.` : _`Not copied, because the browser does not allow it: select the text instead.`))),
      element("h2", { textContent: _`Load` }),
      element("div", { className: "row" }, element("label", { for: "landmark-files", textContent: _`Landmark files` }), this.file),
      element("p", { className: "note", textContent: _`Files of 3D Slicer (.mrk.json), or drop them anywhere on this page. Loaded sites replace those placed here; undo brings them back.` }));
    document.addEventListener("dragover", (e) => e.preventDefault());
    document.addEventListener("drop", (e) => {
      e.preventDefault();
      this.loadAll([...e.dataTransfer.files]);
    });
  }

  show() {
    const open = this.app.shown.filter(({ state }) => state === "missing").length;
    this.note.textContent = open
      ? _`${open} missing sites are saved as not placed.`
      : _`All sites are saved, each with its state as its description.`;
  }

  /** Saves into the case, where the page was opened from the desk. */
  caseRow() {
    deskState().then(({ seen }) => { this.seen = seen; });
    return element("div", { className: "row" },
      button(_`Save in the case`, () => this.saveInCase(), { id: "save-in-case" }),
      element("a", { href: "./", textContent: _`Back to the desk` }));
  }

  async saveInCase() {
    try {
      const texts = Object.fromEntries(this.kinds.map((kind) => [kind, this.markups(kind)]));
      ({ seen: this.seen } = await call("save-landmarks", { seen: this.seen, ...texts }));
      this.app.savedAt = this.app.history.now;
      globalThis.location.assign("./");
    } catch (error) {
      this.app.report(_`Not saved: ${error.message}.`);
    }
  }

  /** The text of the file of a kind. */
  markups(kind) {
    const { page, shown } = this.app;
    return markupsText(page.sites.flatMap((site, i) => (site.kind === kind ? [{ name: site.name, doubt: site.doubt, ...saved(shown[i]) }] : [])));
  }

  save(kind) {
    save(fileOf(kind), this.markups(kind), "application/json");
    this.app.savedAt = this.app.history.now;
  }

  async loadAll(files) {
    this.file.value = "";
    const reports = [];
    let decided = new Map(this.app.decided);
    for (const file of files) {
      try {
        if (file.size > MOST_BYTES) throw new Error(_`it has ${file.size} bytes, which is too large for landmarks`);
        const { app } = this;
        const { points, stated } = markupsOf(await file.text());
        const { kind, found, warnings } = sitesOf(points, app.page.sites, (part, point) => app.away(part, point), file.name);
        const kept = [...decided].filter(([i]) => app.page.sites[i].kind !== kind);
        // Those that a person placed first: they move the others.
        const first = new Map([...kept, ...found.filter((f) => ["placed", "accepted"].includes(f.origin)).map((f) => [f.site, f])]);
        const shown = app.derived(first);
        const placed = decidedOf(found, shown, MOVED);
        decided = new Map([...kept, ...placed.map(({ site, point, origin }) => [site, { point, origin: origin === "accepted" ? "accepted" : "placed" }])]);
        if (!stated) warnings.unshift(_`it does not state its frame: read as LPS`);
        reports.push(_`${file.name}: ${placed.length} ${kind} sites loaded${warnings.length ? `; ${warnings.join("; ")}` : ""}.`);
      } catch (error) {
        reports.push(_`${file.name}: ${error.message}. Nothing was loaded from it.`);
      }
    }
    if (decided.size !== this.app.decided.size || [...decided].some(([i, d]) => this.app.decided.get(i) !== d)) this.app.decide(decided);
    this.app.report(reports.join(" "));
  }
}

/** A shown site as a file has it. */
function saved({ state, point, error }) {
  if (state === "missing") return { point: null, origin: "filled", error };
  const origin = state === "doubtful" ? "proposed" : state;
  return { point, origin, error };
}

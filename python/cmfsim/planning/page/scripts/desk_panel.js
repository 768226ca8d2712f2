// The plan in the case file, and the report of it, where the page was opened from the desk.

import { WorkView, call, findingList } from "./desk_calls.js";
import { _, button, element } from "./elements.js";
import { planDigits } from "./exporting.js";

export class DeskPanel {
  constructor(app) {
    this.app = app;
    this.root = element("div");
    if (!app.page.on_desk) return;
    this.seen = null;
    this.state = { digits: "", files: [], findings: [] };
    this.note = element("p", { className: "state", id: "desk-state", role: "status" });
    this.saving = button(_`Save the plan in the case`, () => this.save(), { id: "save-in-case" });
    this.predicting = button(_`Predict, and write the report`, () => this.report(), { id: "predict" });
    this.links = element("div", { className: "row", id: "reports" });
    this.warnings = element("div");
    this.work = new WorkView((state) => {
      this.seen ??= state.seen;
      this.state = state;
      this.warnings.replaceChildren(findingList(state.findings));
      this.show();
    });
    this.root.append(
      element("h2", { textContent: _`Case` }),
      element("div", { className: "row" }, this.saving, this.predicting, element("a", { href: "./", textContent: _`Back to the desk` })),
      this.note, this.work.root, this.links, this.warnings);
    this.work.watch();
  }

  get isSaved() {
    const { page, plans } = this.app;
    return this.state.digits === planDigits(page, plans.active.motions);
  }

  show() {
    if (!this.app.page.on_desk) return;
    const { digits, files, work } = this.state;
    this.note.textContent = this.isSaved ? _`The case file has this plan (${digits}).` : _`The case file has another plan than the one shown: save it.`;
    this.note.classList.toggle("warning", !this.isSaved);
    this.saving.disabled = this.isSaved || !this.seen;
    this.predicting.disabled = !this.isSaved || Boolean(work);
    const names = { "report.html": _`Open the report`, "report.pdf": _`Open the page for the chart (PDF)` };
    this.links.replaceChildren(...(this.isSaved ? files : []).map((file) =>
      element("a", { href: file, target: "_blank", rel: "noopener", textContent: names[file] ?? file })));
  }

  async save() {
    try {
      this.state = await call("save-plan", { seen: this.seen, motions: this.app.plans.active.motions });
      this.seen = this.state.seen;
      this.work.fail("");
      this.show();
    } catch (error) {
      this.work.fail(_`Not saved: ${error.message}.`);
    }
  }

  async report() {
    this.predicting.disabled = true;
    try {
      await call("report");
      await this.work.watch(true);
    } catch (error) {
      this.work.fail(`${error.message}.`);
    }
  }
}

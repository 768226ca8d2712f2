// What leaves the page: the plan, its transforms, the face, a picture; and a plan that comes back.

import { _, button, copied, element } from "./elements.js";
import { fileName, planDigits, planOf, planText, save, stlBytes, transformText } from "./exporting.js";

// A plan of a hundred segments has some 30 kB.
const MOST_BYTES = 1_000_000;

export class ExportPanel {
  constructor(app) {
    this.app = app;
    const { page } = app;
    this.direction = element("select", { id: "direction" },
      element("option", { value: "from-parent", textContent: _`from-parent: as 3D Slicer saves and shows it` }),
      element("option", { value: "to-parent", textContent: _`to-parent: the motion of the bone itself` }));
    this.file = element("input", { type: "file", accept: ".toml", id: "plan-file", onchange: (e) => this.load(e.target) });
    this.command = element("code", { id: "command" });
    this.root = element("div", {},
      element("h2", { textContent: _`Solve exactly` }),
      element("p", { className: "note", textContent: page.exact_note }),
      this.command,
      element("div", { className: "row" },
        button(_`Save the plan`, () => this.savePlan(), { id: "save-plan" }),
        button(_`Copy the command`, async () => app.report((await copied(this.command.textContent)) ? _`Copied.` : _`Not copied, because the browser does not allow it: select the text instead.`))),
      element("h2", { textContent: _`Files` }),
      element("div", { className: "row" }, element("label", { for: "plan-file", textContent: _`Load a plan` }), this.file),
      element("div", { className: "row" }, element("label", { for: "direction", textContent: _`Direction` }), this.direction,
        button(_`Save the segment's transform (.tfm)`, () => this.saveTransform(), { id: "save-transform" })),
      element("div", { className: "row" },
        button(_`Save the face (STL)`, () => this.saveFace(), { id: "save-face" }),
        button(_`Save a picture (PNG)`, () => app.savePicture(), { id: "save-picture" })),
      element("p", { className: "note", textContent: _`Coordinates are LPS in mm. The face comes from the plan operator and is not solved exactly.` }));
  }

  get stem() {
    const { page, plans } = this.app;
    const digits = planDigits(page, plans.active.motions);
    return `${fileName(page.case)}-${fileName(plans.active.name)}-${digits}`;
  }

  show() {
    this.command.textContent = `cmfsim predict ${this.app.page.case_file} --plan ${this.stem}.toml --model ${this.app.page.model}`;
  }

  savePlan() {
    save(`${this.stem}.toml`, planText(this.app.page, this.app.plans.active), "text/plain");
  }

  saveTransform() {
    const { page, panel, plans } = this.app;
    const direction = this.direction.value;
    const name = `${this.stem}-${fileName(page.segments[panel.segment].name)}.${direction}.tfm`;
    save(name, transformText(plans.active.motions[panel.segment], direction), "text/plain");
  }

  saveFace() {
    save(`${this.stem}.stl`, stlBytes(this.app.after, this.app.face.triangles), "model/stl");
  }

  async load(input) {
    const file = input.files[0];
    if (!file) return;
    try {
      if (file.size > MOST_BYTES) throw new Error(_`it has ${file.size} bytes, which is too large for a plan`);
      const { motions, warning } = planOf(this.app.page, await file.text());
      this.app.load(motions, warning);
    } catch (error) {
      this.app.report(_`${file.name}: ${error.message}. No plan was loaded.`);
    }
    input.value = "";
  }
}

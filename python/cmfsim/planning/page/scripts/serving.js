// Exact solutions from the program that served this page, where one did.

import { _ } from "./elements.js";

// A plan is sent when nothing has changed for so long, ms.
const PAUSE = 250;

export class ExactSolver {
  /** app gives: page, face, plans, changed(); `state` is shown by the app. */
  constructor(app) {
    this.app = app;
    this.state = "";
    this.running = false;
  }

  /** Asks for the plan that is kept now, unless it is solved already. */
  ask() {
    clearTimeout(this.timer);
    const { page, face, plans } = this.app;
    const { motions } = plans.active;
    if (!page.is_served || face.isExact(motions) || face.isReference(motions)) return;
    // What could not be solved is not asked for again.
    if (this.failed === motions) return;
    this.timer = setTimeout(() => this.solve(), PAUSE);
  }

  async solve() {
    // One at a time; what changed meanwhile is asked for afterwards.
    if (this.running) return;
    this.running = true;
    const { motions } = this.app.plans.active;
    this.failed = null;
    this.show(_`Solving this plan exactly …`);
    try {
      const answer = await fetch("solve", {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ motions }),
      });
      if (!answer.ok) throw new Error(await answer.text());
      const figures = JSON.parse(answer.headers.get("X-Solution"));
      this.app.face.takeExact(motions, new Float32Array(await answer.arrayBuffer()), figures);
      this.show("");
    } catch (error) {
      this.failed = motions;
      this.show(_`Not solved exactly: ${error.message || _`the program that served this page has ended`}.`);
    }
    this.running = false;
    this.app.changed();
  }

  show(text) {
    this.state = text;
    this.app.showError();
  }
}

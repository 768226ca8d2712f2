// What pages of the desk ask its server, and the work that runs there.

import { _, button, element } from "./elements.js";

const EVERY_MS = 600;

async function answered(answer) {
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** The answer to a call with values. */
export const call = async (name, values = {}) => answered(await fetch(name, {
  method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values),
}));

/** The state of the desk: work, error, seen (what the case file is), digits and files. */
export const deskState = async () => answered(await fetch("state"));

/** Warnings and errors that were noticed, with their remedies; closed at first. */
export const findingList = (findings) => element("details", { hidden: !findings.length, className: "findings" },
  element("summary", { textContent: _`${findings.length} warning${findings.length === 1 ? "" : "s"}` }),
  ...findings.map(({ severity, code, what, where, fix }) => element("p", { className: "state warning", textContent: `${severity} (${code}${where ? `, ${where}` : ""}): ${what}${fix ? _`. Fix: ${fix}` : ""}` })));

/** The progress of the work on the server, with a button that stops it. */
export class WorkView {
  /** ended(state, ran) is called with the state once nothing runs; ran: whether something did. */
  constructor(ended) {
    this.ended = ended;
    this.name = element("strong", { role: "status" });
    this.bar = element("progress", { max: 1, "aria-label": _`Share of the time that has passed` });
    this.stage = element("span", { className: "note" });
    this.running = element("div", { id: "work", hidden: true }, this.name, this.bar, this.stage,
      button(_`Stop`, async () => { await call("cancel"); }, { id: "stop" }));
    this.error = element("p", { className: "state warning", id: "work-error", role: "alert" });
    this.root = element("div", { className: "work" }, this.running, this.error);
  }

  /** Shows the work until none runs. */
  async watch(ran = false) {
    let state = null;
    try {
      state = await deskState();
    } catch (error) {
      this.fail(_`The program that served this page does not answer (${error.message}): start cmfsim desk again.`);
      return;
    }
    const { work } = state;
    this.running.hidden = !work;
    if (!work) {
      this.fail(state.error);
      this.ended(state, ran);
      return;
    }
    this.error.textContent = "";
    if (this.name.textContent !== work.name) this.name.textContent = work.name;
    if (work.share === null) this.bar.removeAttribute("value");
    else this.bar.value = work.share;
    const left = work.left === null ? "" : _`${Math.round(100 * work.share)} %, about ${work.left < 100 ? `${Math.round(work.left)} s` : _`${Math.round(work.left / 60)} min`} left: `;
    this.stage.textContent = `${left}${work.stage}`;
    setTimeout(() => this.watch(true), EVERY_MS);
  }

  fail(text) { this.error.textContent = text; }
}

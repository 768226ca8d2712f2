// Questions that the program could not decide about the files, with their choices.

import { _, button, element } from "./elements.js";

/** The step that asks; answered(question, toml) is called with what was chosen or typed. */
export function questionStep(questions, answered) {
  return element("section", { className: "step", "aria-label": _`Questions about the files` },
    element("h2", { textContent: _`Questions about the files (${questions.length})` }),
    ...questions.map((question, q) => asked(question, q, answered)));
}

function asked(question, q, answered) {
  const typed = element("input", { type: "text", id: `typed-${q}`, "aria-label": _`${question.key}: another answer`, placeholder: 'such as "name.stl" or [1, -1024]' });
  return element("fieldset", {},
    element("legend", { textContent: `${question.key}: ${question.text}` }),
    ...question.choices.map(({ toml, words }) => element("div", { className: "choice" },
      button(words, () => answered(question, toml), { "data-toml": toml }))),
    element("div", { className: "choice" }, typed, button(_`Use this`, () => answered(question, typed.value.trim()), { id: `use-${q}` })));
}

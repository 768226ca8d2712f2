// Buttons of the standard views, and sliders of what is shown.

import { VIEWS } from "./camera.js";
import { button, element } from "./elements.js";

/** Turns the camera to a standard view by its number. */
export function look(app, index) {
  app.camera.look(VIEWS[index]);
  app.redraw();
}

/** Buttons of the standard views, the last of which shows the whole. */
export function addViews(app, whole) {
  document.getElementById("views").append(
    ...VIEWS.map((view, i) => button(view.name, () => look(app, i), { title: `key ${i + 1}` })),
    button(whole, () => { app.camera.recentre(); app.redraw(); }, { title: "key 0" }));
}

/** A slider from 0 to 1 with its label. */
export const slider = (id, label, value, onchange) => element("label", {}, label, element("input", {
  type: "range", min: 0, max: 1, step: 0.01, value, id, oninput: (e) => onchange(Number(e.target.value)),
}));

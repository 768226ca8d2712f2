// Mouse, pen, touch and keys over the picture: what the page lets be grabbed first, else the camera.

import { look } from "./view_panel.js";

const TURN_PER_PIXEL = 0.4;
const KEY_TURN = 5;
const KEY_ZOOM = 1.1;
// A press that moves less than this, in pixels, is a click.
const CLICK_REACH = 4;

/**
 * Connects the overlay with the app.
 *
 * app gives: overlay, camera, redraw(); canGrab(place) for the cursor; grab(place), what a press
 * takes hold of, as {drag(place), release()}, or null; and clicked(place), if it has clicks. If it
 * is a part of a page to scroll, the wheel zooms only in a picture that was clicked on.
 */
export function connectPointing(app) {
  const { overlay, camera } = app;
  const down = new Map();
  let held = null;
  let pressed = null;
  const place = (e) => {
    const box = overlay.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  };
  const released = () => {
    const was = held;
    held = null;
    was?.release();
  };
  overlay.addEventListener("pointerdown", (e) => {
    overlay.focus({ preventScroll: true });
    overlay.setPointerCapture(e.pointerId);
    down.set(e.pointerId, place(e));
    pressed = null;
    if (down.size > 1) {
      // A second finger: the first one no longer pulls.
      released();
    } else if (e.button === 0 && !e.shiftKey) {
      held = app.grab(place(e));
      if (!held) pressed = place(e);
    }
  });
  overlay.addEventListener("pointermove", (e) => {
    if (!down.has(e.pointerId)) {
      overlay.style.cursor = app.canGrab(place(e)) ? "grab" : "default";
      return;
    }
    const [x, y] = place(e);
    if (held) {
      held.drag([x, y]);
      return;
    }
    if (pressed && Math.hypot(x - pressed[0], y - pressed[1]) > CLICK_REACH) pressed = null;
    const [ox, oy] = down.get(e.pointerId);
    const height = overlay.clientHeight;
    if (down.size === 2) {
      const [other] = [...down.entries()].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
      camera.zoom(Math.hypot(ox - other[0], oy - other[1]) / Math.max(1, Math.hypot(x - other[0], y - other[1])));
      camera.pan((x - ox) / height / 2, -(y - oy) / height / 2);
    } else if (e.buttons === 2 || e.buttons === 4 || e.shiftKey) {
      camera.pan((x - ox) / height, -(y - oy) / height);
    } else {
      camera.turn(-TURN_PER_PIXEL * (x - ox), TURN_PER_PIXEL * (y - oy));
    }
    down.set(e.pointerId, [x, y]);
    app.redraw();
  });
  const lifted = (e) => {
    down.delete(e.pointerId);
    if (!down.size) released();
    if (pressed && e.type === "pointerup") app.clicked?.(pressed);
    pressed = null;
  };
  overlay.addEventListener("pointerup", lifted);
  overlay.addEventListener("pointercancel", lifted);
  overlay.addEventListener("contextmenu", (e) => e.preventDefault());
  overlay.addEventListener("wheel", (e) => {
    if (app.isPart && document.activeElement !== overlay) return;
    e.preventDefault();
    camera.zoom(Math.exp(e.deltaY / 800));
    app.redraw();
  }, { passive: false });
}

export function connectKeys(app) {
  const { overlay, camera } = app;
  overlay.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const actions = {
      ArrowLeft: () => camera.turn(-KEY_TURN, 0), ArrowRight: () => camera.turn(KEY_TURN, 0),
      ArrowUp: () => camera.turn(0, KEY_TURN), ArrowDown: () => camera.turn(0, -KEY_TURN),
      "+": () => camera.zoom(1 / KEY_ZOOM), "-": () => camera.zoom(KEY_ZOOM), 0: () => camera.recentre(),
    };
    for (let i = 1; i <= 6; i++) actions[i] = () => look(app, i - 1);
    if (!Object.hasOwn(actions, e.key)) return;
    actions[e.key]();
    e.preventDefault();
    app.redraw();
  });
  document.addEventListener("keydown", (e) => {
    // Texts have an undo of their own.
    if (!(e.ctrlKey || e.metaKey) || e.target.type === "text") return;
    const key = e.key.toLowerCase();
    if (key === "z" && !e.shiftKey) app.undo();
    else if (key === "y" || key === "z") app.redo();
    else return;
    e.preventDefault();
  });
}

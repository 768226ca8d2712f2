// The midline profile, before and after, seen from the patient's right.

import { DISTINCT } from "./colours.js";

const MARGIN = 10;

/** Strokes polylines of (y, z), mm, at their places in a picture; `unit`: of their thickness, pixels. */
export function drawLines(pen, lines, place, unit = 1) {
  for (const { points, colour, thick, dash } of lines) {
    pen.strokeStyle = colour;
    pen.lineWidth = thick * unit;
    pen.setLineDash((dash ?? []).map((length) => length * unit));
    pen.beginPath();
    points.forEach((p, i) => (i && p[2] !== false ? pen.lineTo(...place(p)) : pen.moveTo(...place(p))));
    pen.stroke();
  }
  pen.setLineDash([]);
}

/** Draws polylines of (y, z) in mm: [{points, colour, width, dash}], with a bar of 10 mm. */
export function drawProfile(canvas, lines) {
  const ratio = globalThis.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const all = lines.flatMap((line) => line.points);
  if (!all.length || !width) return;
  const [ys, zs] = [0, 1].map((i) => all.map((p) => p[i]));
  const [low, high] = [Math.min(...ys), Math.max(...ys)];
  const [bottom, top] = [Math.min(...zs), Math.max(...zs)];
  const scale = Math.min((width - 2 * MARGIN) / (high - low), (height - 2 * MARGIN) / (top - bottom));
  // Forwards (−P) to the right.
  const place = ([y, z]) => [
    width / 2 - scale * (y - (low + high) / 2),
    height / 2 - scale * (z - (bottom + top) / 2),
  ];
  drawLines(pen, lines, place);
  pen.strokeStyle = pen.fillStyle = "#3a4450";
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(MARGIN, height - MARGIN);
  pen.lineTo(MARGIN + 10 * scale, height - MARGIN);
  pen.stroke();
  pen.font = "12px system-ui, sans-serif";
  pen.fillText("10 mm", MARGIN, height - MARGIN - 5);
}

export const variantColour = (index) => DISTINCT[index % DISTINCT.length];

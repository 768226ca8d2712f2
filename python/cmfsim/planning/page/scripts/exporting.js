// Files that leave the page, and plans that come back.

import { _ } from "./elements.js";
import { inverse, rigidError } from "./rigid.js";

// A segment's name as a key of TOML, quoted where it has to be.
const BARE = /^[A-Za-z0-9_-]+$/;
// What a rotation typed or rounded elsewhere may be off by.
const MOST_ROUNDING = 1e-5;
const FIRST = "# cmfsim plan";

const matrixRows = (m) => [0, 4, 8, 12].map((r) => m.slice(r, r + 4));
// A text that stays in its comment or quotes, whatever a case or variant is called.
const oneLine = (text) => JSON.stringify(String(text)).replace(/\u007f|[\u0080-\u009f\u2028\u2029]/g, " ");

// Entries of motions are distinguished to a millionth, mm or of a rotation.
const DIGITS = 1e6;

/**
 * Eight hexadecimal digits that plans of other motions do not share: those that `cmfsim predict`
 * prints (`plan_digits` of Python). Segments that stay do not count.
 */
export function planDigits(page, motions) {
  const texts = page.segments.flatMap(({ name }, s) => {
    const numbers = motions[s].map((v, i) => Math.floor((v - (i % 5 === 0 ? 1 : 0)) * DIGITS + 0.5) + 0);
    return numbers.some((v) => v !== 0) ? [`${name}:${numbers.join(",")}`] : [];
  });
  return checksum(new TextEncoder().encode(texts.sort(byCodePoints).join("\n")));
}

/** The order of Python's strings. */
function byCodePoints(a, b) {
  const [x, y] = [[...a], [...b]].map((text) => text.map((c) => c.codePointAt(0)));
  const i = x.findIndex((c, k) => c !== y[k]);
  return i < 0 ? x.length - y.length : x[i] - (y[i] ?? -1);
}

/** CRC-32 (ISO 3309) in hexadecimal digits. */
function checksum(bytes) {
  let crc = 0xffffffff;
  for (const byte of bytes) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ((crc ^ 0xffffffff) >>> 0).toString(16).padStart(8, "0");
}

/** A plan as `cmfsim predict --plan` reads it, and as a case.toml may hold it. */
export function planText(page, variant) {
  const lines = [
    `${FIRST} ${oneLine(variant.name)} (${planDigits(page, variant.motions)}) of the case ${oneLine(page.case)}. Not a medical device.`,
    "# Each matrix carries the bone from where it is to where it goes: LPS, mm.",
    "# cmfsim predict case.toml --plan THIS_FILE; or copy the tables into the case in place of its [plan].",
    `# made for: ${page.built_for}`,
  ];
  page.segments.forEach(({ name }, s) => {
    const rows = matrixRows(variant.motions[s]).map((row) => `  [${row.map(number).join(", ")}],`);
    lines.push("", `[plan.${BARE.test(name) ? name : oneLine(name)}]`, "matrix = [", ...rows, "]");
  });
  return lines.join("\n") + "\n";
}

const number = (v) => (Number.isInteger(v) ? `${v === 0 ? 0 : v}.0` : String(v));

/**
 * The motions in the text of a plan, in the order of the page's segments, with a warning.
 *
 * It reads what `planText` writes. Everything else is refused with its line, so that a plan is
 * never read in part.
 */
export function planOf(page, text) {
  const found = readTables(text);
  const names = page.segments.map((s) => s.name);
  const strange = Object.keys(found).filter((name) => !names.includes(name));
  if (strange.length) throw new Error(_`the plan moves ${strange[0]}, which this page does not have: ${names.join(", ")}`);
  const missing = names.filter((name) => !(name in found));
  if (missing.length) throw new Error(_`the plan does not mention ${missing.join(", ")}: give the identity matrix to segments that do not move`);
  for (const name of names) {
    const matrix = found[name];
    if (matrix.slice(12).join() !== "0,0,0,1") throw new Error(_`${name}: the last row is not 0, 0, 0, 1`);
    const error = rigidError(matrix);
    if (!(error <= MOST_ROUNDING)) throw new Error(_`${name}: not a rotation and a translation (off by ${error.toExponential(1)})`);
  }
  const made = /^# made for: (.+)$/m.exec(text)?.[1].trim();
  let warning = "";
  if (!made) warning = _`The file does not state which case it was made for: check the numbers.`;
  else if (made !== page.built_for) warning = _`The file was made for another case, or for an earlier version of this one: check the numbers.`;
  return { motions: names.map((name) => found[name]), warning };
}

function readTables(text) {
  const found = {};
  let name = null;
  let pending = "";
  text.split(/\r?\n/).forEach((raw, i) => {
    const line = raw.trim();
    if (!line || line.startsWith("#")) return;
    const fail = (why) => { throw new Error(_`line ${i + 1}: ${why}; the page reads only plans that it saved itself`); };
    const head = /^\[plan\.(?:([A-Za-z0-9_-]+)|("(?:[^"\\]|\\.)*"))\]$/.exec(line);
    if (head && !pending) {
      name = head[1] ?? JSON.parse(head[2]);
      if (Object.hasOwn(found, name)) fail(_`${name} appears a second time`);
      return;
    }
    if (name === null) fail(_`not a table [plan.SEGMENT]`);
    if (!pending && !line.startsWith("matrix")) fail(_`not a matrix`);
    pending += line;
    if ((pending.match(/\[/g) ?? []).length > (pending.match(/\]/g) ?? []).length) return;
    const body = /^matrix\s*=\s*(\[.*\])$/.exec(pending)?.[1];
    if (!body) fail(_`not a matrix`);
    let rows;
    try { rows = JSON.parse(body.replace(/,\s*\]/g, "]")); } catch { fail(_`not numbers`); }
    const flat = Array.isArray(rows) ? rows.flat() : [];
    if (rows.length !== 4 || flat.length !== 16 || !flat.every(Number.isFinite)) fail(_`not 4 × 4 finite numbers`);
    found[name] = flat;
    name = null;
    pending = "";
  });
  if (pending || name !== null) throw new Error(_`the file ends inside a table`);
  return found;
}

/** A motion as an ITK transform (.tfm). `direction` says what its numbers do. */
export function transformText(motion, direction) {
  const m = direction === "from-parent" ? inverse(motion) : motion;
  const numbers = [m.slice(0, 3), m.slice(4, 7), m.slice(8, 11), [m[3], m[7], m[11]]].flat();
  return [
    "#Insight Transform File V1.0",
    `# mm, LPS, ${direction}`,
    "#Transform 0",
    "Transform: AffineTransform_double_3_3",
    `Parameters: ${numbers.map((v) => v + 0).join(" ")}`,
    "FixedParameters: 0 0 0",
    "",
  ].join("\n");
}

/** A surface as binary STL, LPS mm, as its header states. */
export function stlBytes(places, triangles) {
  const count = triangles.length / 3;
  const view = new DataView(new ArrayBuffer(84 + 50 * count));
  [..."cmfsim planning page; mm; SPACE=LPS; not a medical device"].forEach((c, i) => view.setUint8(i, c.charCodeAt(0)));
  view.setUint32(80, count, true);
  for (let t = 0; t < count; t++) {
    for (let corner = 0; corner < 3; corner++) {
      for (let axis = 0; axis < 3; axis++) {
        const value = places[3 * triangles[3 * t + corner] + axis];
        view.setFloat32(84 + 50 * t + 12 + 12 * corner + 4 * axis, value, true);
      }
    }
  }
  return view.buffer;
}

/** Gives a file to the user. */
export function save(name, content, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** A text as part of a file name. */
export const fileName = (text) => String(text).replace(/[^A-Za-z0-9_-]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 40) || "plan";

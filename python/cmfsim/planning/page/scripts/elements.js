// Elements of the document, and its texts, which go in as text, never as markup.

/** The translations of texts that the page has: see values/language.py. */
const TEXTS = JSON.parse(globalThis.document?.getElementById("page-values")?.textContent ?? "{}").texts ?? {};

/** A text in the reader's language, as the tag of a template; the message has {0} for a value. */
export function _(parts, ...values) {
  const message = parts.reduce((text, part, i) => `${text}{${i - 1}}${part}`);
  return (TEXTS[message] ?? message).replace(/\{(\d+)\}/g, (whole, i) => values[i] ?? whole);
}

/** An element with properties, `data-` and `aria-` attributes, listeners (`on…`) and children. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (/^(aria|data)-|^(role|for|scope|colspan)$/.test(name)) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children.filter((c) => c !== null && c !== undefined));
  return made;
}

export const button = (text, onclick, more = {}) =>
  element("button", { type: "button", textContent: text, onclick, ...more });

/** The pen of a canvas as large as its element, in the element's pixels, on an empty ground. */
export function cleared(canvas) {
  const ratio = globalThis.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { pen, width, height };
}

/** A table of texts: heads, and rows whose first cell is their head. */
export function table(caption, heads, rows) {
  return element("div", { className: "wide" }, element("table", {},
    element("caption", { textContent: caption }),
    element("thead", {}, element("tr", {}, ...heads.map((h) => element("th", { scope: "col", textContent: h })))),
    element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map((cell, i) =>
      element(i ? "td" : "th", i ? { textContent: cell } : { scope: "row", textContent: cell }))))),
  ));
}

/** A field for a number: as text, because browsers drop a decimal comma from a field of numbers. */
export const numberField = (properties) =>
  element("input", { type: "text", inputMode: "decimal", autocomplete: "off", className: "number", ...properties });

/** The number that a person typed, a comma being its point; NaN for everything else. */
export function typedNumber(text) {
  const plain = text.trim().replace(/^[−–]/, "-").replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(plain) ? Number(plain) : NaN;
}

/** A number with its sign, such as "+1.2" or "−0.3"; "0.0" has none. */
export function signed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? "−" : "+") + text;
}

/** A number as people read it. */
export const shown = (value, digits = 1) => (value < 0 && Number(value.toFixed(digits)) !== 0 ? "−" : "") + Math.abs(value).toFixed(digits);

/** The kind of text that a copy button needs; says whether it worked. */
export async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false;
  }
}

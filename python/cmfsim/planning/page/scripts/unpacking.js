// The numbers of the page: one block of bytes, gzip in base64, with a table of its arrays.

import { _ } from "./elements.js";

const TYPES = { float32: Float32Array, uint32: Uint32Array, float16: Uint16Array };

/** The arrays of the page by name, each {values, shape}; half precision becomes single. */
export async function unpack(text, table) {
  const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = await new Response(stream).arrayBuffer();
  const arrays = {};
  for (const { name, type, shape, start } of table) {
    const count = shape.reduce((product, size) => product * size, 1);
    const raw = new TYPES[type](bytes, start, count);
    arrays[name] = { values: type === "float16" ? fromHalf(raw) : raw, shape };
  }
  return arrays;
}

/** Makes the app of the page from its values and its arrays, or shows why there is none. */
export async function start(App) {
  try {
    const page = JSON.parse(document.getElementById("page-values").textContent);
    const arrays = await unpack(document.getElementById("page-numbers").textContent, page.arrays);
    // For the console, and for tests.
    globalThis.cmfsimPage = new App(page, arrays);
  } catch (error) {
    const box = document.getElementById("failure");
    box.textContent = _`The picture cannot be shown: ${error.message}`;
    box.hidden = false;
    throw error;
  }
}

/** Half precision (IEEE 754 binary16) as single precision. */
export function fromHalf(halves) {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    let size = fraction * 2 ** -24;
    if (exponent === 31) size = fraction ? NaN : Infinity;
    else if (exponent > 0) size = (1024 + fraction) * 2 ** (exponent - 25);
    table[bits] = bits & 0x8000 ? -size : size;
  }
  const singles = new Float32Array(halves.length);
  for (let i = 0; i < halves.length; i++) singles[i] = table[halves[i]];
  return singles;
}

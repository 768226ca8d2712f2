// Colours that people with any colour vision tell apart.

// Viridis (Smith and van der Walt 2015): evenly rising lightness. Eleven of its colours.
const VIRIDIS = [
  [68, 1, 84], [72, 36, 117], [65, 68, 135], [53, 95, 141], [42, 120, 142], [33, 145, 140],
  [34, 168, 132], [68, 191, 112], [122, 209, 81], [189, 223, 38], [253, 231, 37],
];
// Okabe and Ito (2008), for variants.
export const DISTINCT = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];
export const SKIN = [0.91, 0.75, 0.65];
export const STILL_BONE = [0.9, 0.87, 0.8];

/** The colour of a share from 0 to 1, as three numbers from 0 to 1. */
export function mapped(share) {
  const place = Math.max(0, Math.min(1, share)) * (VIRIDIS.length - 1);
  const low = Math.min(VIRIDIS.length - 2, Math.floor(place));
  return VIRIDIS[low].map((v, i) => (v + (place - low) * (VIRIDIS[low + 1][i] - v)) / 255);
}

/** "#rrggbb" as three numbers from 0 to 1. */
export function rgb(hex) {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
}

export const MAP_COLOURS = VIRIDIS.map((c) => `rgb(${c.join(",")})`);

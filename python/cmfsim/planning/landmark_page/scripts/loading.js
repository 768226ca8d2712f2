// Landmarks that come back from files: whose they are, and whether they can be this head's.

import { _ } from "./elements.js";
import { isDecided } from "./site_states.js";

// Medians of distances from bone or skin, mm: above FAR the file is of something else, and a frame
// that brings the points closer than NEAR is the right one.
const FAR = 5, NEAR = 3;
// A single point farther from its surface than this, mm, is not this site.
const OFF = 8;
// A left site that lies this far to the right of its partner, mm, is on the wrong side.
const SIDE_MARGIN = 3;

/** What two spellings of a label have in common. */
export const labelKey = (label) => label.toLowerCase().split(/[\s_-]+/).filter(Boolean).join("_");

/**
 * The sites of the points of a file: {site: index, point, origin} each, with warnings.
 *
 * sites: of the page; away(part, point): distance from the surface of a part, mm; name: of the file.
 */
export function sitesOf(points, sites, away, name) {
  const kind = kindOf(points, sites, name);
  const known = new Map(sites.flatMap((s, i) => (s.kind === kind ? s.labels.map((key) => [key, i]) : [])));
  const found = [], unknown = [];
  for (const entry of points) {
    const site = known.get(labelKey(entry.label));
    if (site === undefined) unknown.push(entry.label);
    else if (found.some((f) => f.site === site)) throw new Error(_`it has ${sites[site].name} twice`);
    else found.push({ ...entry, site });
  }
  if (!found.length) throw new Error(_`none of its labels is a site of the ${kind}: ${listed(unknown)}`);
  checkFrame(found, sites, away);
  checkSides(found, sites);
  const off = found.filter((f) => away(sites[f.site].part, f.point) > OFF);
  const warnings = [];
  if (unknown.length) warnings.push(_`unknown labels were skipped: ${listed(unknown)}`);
  if (off.length) warnings.push(_`skipped because they lie more than ${OFF} mm from their surface: ${listed(off.map((f) => f.label))}`);
  return { kind, found: found.filter((f) => !off.includes(f)), warnings };
}

/** "skull" or "skin", by the labels that only one of them has, or else by the name of the file. */
function kindOf(points, sites, name) {
  const counts = { skull: 0, skin: 0 };
  for (const { label } of points) {
    const kinds = new Set(sites.filter((s) => s.labels.includes(labelKey(label))).map((s) => s.kind));
    if (kinds.size === 1) counts[[...kinds][0]]++;
  }
  if (counts.skull && counts.skin) throw new Error(_`it has sites of both skull and skin: save them in two files`);
  if (counts.skull || counts.skin) return counts.skull ? "skull" : "skin";
  const said = ["skull", "skin"].filter((kind) => name.toLowerCase().includes(kind));
  if (said.length !== 1) throw new Error(_`its labels do not tell skull from skin: put “skull” or “skin” into the name of the file`);
  return said[0];
}

function checkFrame(found, sites, away) {
  const distance = (signs) => median(found.map(({ site, point }) => away(sites[site].part, point.map((v, i) => signs[i] * v))));
  const own = distance([1, 1, 1]);
  if (own <= FAR) return;
  if (distance([-1, -1, 1]) < NEAR) {
    throw new Error(_`its points fit this head only with x and y reversed: the file states the wrong frame (LPS and RAS are exchanged)`);
  }
  throw new Error(_`half of its points lie more than ${own.toFixed(0)} mm from the bone or skin: it belongs to another patient or image`);
}

function checkSides(found, sites) {
  const at = new Map(found.map((f) => [sites[f.site].name, f.point]));
  const wrong = [...at.keys()].filter((name) => {
    const right = at.get(name.replace(/_L$/, "_R"));
    return name.endsWith("_L") && right && at.get(name)[0] < right[0] - SIDE_MARGIN;
  });
  if (wrong.length) throw new Error(_`left and right are exchanged: ${listed(wrong)} lies on the patient's right`);
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)];
}

export const listed = (names, most = 5) =>
  names.slice(0, most).join(", ") + (names.length > most ? _` and ${names.length - most} more` : "");

/** Of the loaded sites, those that a person placed: also by moving a proposed one elsewhere. */
export function decidedOf(found, shown, moved) {
  return found.filter(({ site, point, origin }) =>
    isDecided(origin) || Math.hypot(...point.map((v, i) => v - shown[site].point[i])) > moved);
}

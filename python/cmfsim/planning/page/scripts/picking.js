// What of a surface is seen at a place of the picture.

/**
 * The point of a surface that is seen at (x, y) of a picture of this size, in pixels; null for none.
 *
 * Gives the point, mm, the index of its triangle and the shares of its corners, its depth (larger is nearer to the viewer, mm), and
 * the corner that is nearest in the picture.
 */
export function seenPoint(camera, places, triangles, [x, y], width, height) {
  const { right, up, towards } = camera.axes();
  const scale = height / camera.span;
  const [tx, ty, tz] = camera.target;
  const seen = new Float64Array(places.length);
  for (let i = 0; i < places.length; i += 3) {
    const a = places[i] - tx, b = places[i + 1] - ty, c = places[i + 2] - tz;
    seen[i] = width / 2 + scale * (right[0] * a + right[1] * b + right[2] * c) - x;
    seen[i + 1] = height / 2 - scale * (up[0] * a + up[1] * b + up[2] * c) - y;
    seen[i + 2] = towards[0] * a + towards[1] * b + towards[2] * c;
  }
  let best = -1, depth = -Infinity, shares = null;
  for (let t = 0; t < triangles.length; t += 3) {
    const p = 3 * triangles[t], q = 3 * triangles[t + 1], r = 3 * triangles[t + 2];
    const a = seen[q] * seen[r + 1] - seen[r] * seen[q + 1];
    const b = seen[r] * seen[p + 1] - seen[p] * seen[r + 1];
    if (a > 0 !== b > 0 && a !== 0 && b !== 0) continue;
    const c = seen[p] * seen[q + 1] - seen[q] * seen[p + 1];
    if (!((a >= 0 && b >= 0 && c >= 0) || (a <= 0 && b <= 0 && c <= 0))) continue;
    const area = a + b + c;
    if (area === 0) continue;
    const at = (a * seen[p + 2] + b * seen[q + 2] + c * seen[r + 2]) / area;
    if (at <= depth) continue;
    [best, depth, shares] = [t, at, [a / area, b / area, c / area]];
  }
  if (best < 0) return null;
  const corners = [0, 1, 2].map((k) => 3 * triangles[best + k]);
  const nearest = corners.reduce((a, b) => (Math.hypot(seen[a], seen[a + 1]) <= Math.hypot(seen[b], seen[b + 1]) ? a : b));
  return {
    point: [0, 1, 2].map((axis) => corners.reduce((sum, p, k) => sum + shares[k] * places[p + axis], 0)),
    triangle: best / 3,
    shares,
    depth,
    vertex: nearest / 3,
  };
}

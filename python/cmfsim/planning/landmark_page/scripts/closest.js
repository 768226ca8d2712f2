// The closest point of a surface.

export class ClosestPoint {
  constructor(places, triangles) {
    this.places = places;
    this.triangles = triangles;
    // The triangles at each vertex: those of vertex v are around[starts[v]] to around[starts[v + 1]].
    const count = places.length / 3;
    this.starts = new Uint32Array(count + 1);
    for (const v of triangles) this.starts[v + 1]++;
    for (let v = 0; v < count; v++) this.starts[v + 1] += this.starts[v];
    this.around = new Uint32Array(triangles.length);
    const next = this.starts.slice(0, count);
    triangles.forEach((v, i) => { this.around[next[v]++] = Math.floor(i / 3); });
  }

  /** The point of the triangles at the nearest vertex that is closest, and its distance, mm. */
  of(point) {
    const { places } = this;
    const [x, y, z] = point;
    let nearest = 0, least = Infinity;
    for (let i = 0; i < places.length; i += 3) {
      const a = places[i] - x, b = places[i + 1] - y, c = places[i + 2] - z;
      const away = a * a + b * b + c * c;
      if (away < least) [nearest, least] = [i / 3, away];
    }
    let best = { point: [...places.slice(3 * nearest, 3 * nearest + 3)], distance: Math.sqrt(least) };
    for (let k = this.starts[nearest]; k < this.starts[nearest + 1]; k++) {
      const corners = [0, 1, 2].map((c) => {
        const v = 3 * this.triangles[3 * this.around[k] + c];
        return [places[v], places[v + 1], places[v + 2]];
      });
      const found = closestOfTriangle(point, corners);
      const distance = Math.hypot(...found.map((v, i) => v - point[i]));
      if (distance < best.distance) best = { point: found, distance };
    }
    return best;
  }
}

const minus = (a, b) => a.map((v, i) => v - b[i]);
const inner = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const along = (p, d, share) => p.map((v, i) => v + share * d[i]);

/** The point of a triangle that is closest to p (Ericson 2005, Real-Time Collision Detection, 5.1.5). */
function closestOfTriangle(p, [a, b, c]) {
  const ab = minus(b, a), ac = minus(c, a), ap = minus(p, a);
  const d1 = inner(ab, ap), d2 = inner(ac, ap);
  if (d1 <= 0 && d2 <= 0) return a;
  const bp = minus(p, b);
  const d3 = inner(ab, bp), d4 = inner(ac, bp);
  if (d3 >= 0 && d4 <= d3) return b;
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return along(a, ab, d1 / (d1 - d3));
  const cp = minus(p, c);
  const d5 = inner(ab, cp), d6 = inner(ac, cp);
  if (d6 >= 0 && d5 <= d6) return c;
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return along(a, ac, d2 / (d2 - d6));
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 >= d3 && d5 >= d6) return along(b, minus(c, b), (d4 - d3) / (d4 - d3 + (d5 - d6)));
  const sum = va + vb + vc;
  return along(along(a, ab, vb / sum), ac, vc / sum);
}

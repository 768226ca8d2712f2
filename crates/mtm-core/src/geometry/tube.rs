//! Levels of tubes of round or elliptic section along a polyline, positive inside.

/// Points whose levels are computed together, so that they stay in the cache.
const TOGETHER: usize = 256;
/// Nearer to the axis than this share of the section, k₁ says too little, and the level falls from the half thickness.
const AXIS: f64 = 0.05;
/// Smallest number that is divided by.
const TINY: f64 = 1e-6;

/// One end of a segment of a tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TubeEnd {
    /// Its place, mm.
    pub place: [f64; 3],
    /// Unit vector along which the section is thin.
    pub normal: [f64; 3],
    /// Half axis of the section along the normal, mm.
    pub thick: f64,
    /// Half axis of the section across the normal, mm.
    pub wide: f64,
}

/// Level of the nearest of some segments of a tube at points, mm: its section's at the closest point of its axis.
///
/// The bound k₀(1 − k₀)/k₁ of the distance to an ellipse (Quilez 2008), with k₀ and k₁ the lengths of the offset over
/// the half axes and over their squares; where both axes are equal it is the distance. No less than `outside`.
pub fn tube_levels(segments: &[[TubeEnd; 2]], points: &[[f64; 3]], outside: f64) -> Vec<f64> {
    let mut levels = vec![outside; points.len()];
    let (mut x, mut y, mut z) = ([0.0; TOGETHER], [0.0; TOGETHER], [0.0; TOGETHER]);
    for (points, levels) in points.chunks(TOGETHER).zip(levels.chunks_mut(TOGETHER)) {
        for (i, &[a, b, c]) in points.iter().enumerate() {
            (x[i], y[i], z[i]) = (a, b, c);
        }
        for segment in segments {
            let section = Section::of(segment);
            for (i, best) in levels.iter_mut().enumerate() {
                let level = section.level(x[i], y[i], z[i]);
                *best = if level > *best { level } else { *best };
            }
        }
    }
    levels
}

/// A segment as what its level needs: values at its start, and how they change along it.
struct Section {
    start: TubeEnd,
    change: TubeEnd,
    squared_length: f64,
}

impl Section {
    #[inline(always)]
    fn of(&[start, end]: &[TubeEnd; 2]) -> Self {
        let less = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
        let change = TubeEnd {
            place: less(end.place, start.place),
            normal: less(end.normal, start.normal),
            thick: end.thick - start.thick,
            wide: end.wide - start.wide,
        };
        let [x, y, z] = change.place;
        Self { start, change, squared_length: (x * x + y * y + z * z).max(TINY) }
    }

    #[inline(always)]
    fn level(&self, x: f64, y: f64, z: f64) -> f64 {
        let Self { start: a, change: u, squared_length } = self;
        let (px, py, pz) = (x - a.place[0], y - a.place[1], z - a.place[2]);
        let t = (px * u.place[0] + py * u.place[1] + pz * u.place[2]) / squared_length;
        let t = if t > 0.0 { t } else { 0.0 };
        let t = if t < 1.0 { t } else { 1.0 };
        let (qx, qy, qz) = (px - t * u.place[0], py - t * u.place[1], pz - t * u.place[2]);
        let along = qx * (a.normal[0] + t * u.normal[0])
            + qy * (a.normal[1] + t * u.normal[1])
            + qz * (a.normal[2] + t * u.normal[2]);
        let (thick, wide) = (a.thick + t * u.thick, a.wide + t * u.wide);
        let (thick2, wide2) = (thick * thick, wide * wide);
        let u2 = along * along;
        let v2 = (qx * qx + qy * qy + qz * qz) - u2;
        let v2 = if v2 > 0.0 { v2 } else { 0.0 };
        let k0 = (u2 / thick2 + v2 / wide2).sqrt();
        let k1 = (u2 / (thick2 * thick2) + v2 / (wide2 * wide2)).sqrt();
        let k1 = if k1 > TINY { k1 } else { TINY };
        if k0 < AXIS { thick * (1.0 - k0) } else { k0 * (1.0 - k0) / k1 }
    }
}

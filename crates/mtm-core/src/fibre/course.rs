//! Directions from known fibre lines.

use crate::triangle::Vec3;

/// Distance within which a line counts as met, relative to the mean length of the lines: 0.4 mm on
/// a muscle of 40 mm.
const SOFTENING: f64 = 0.01;

/// A line whose ends are nearer than this to each other, relative to its length, is closed.
const CLOSED: f64 = 1e-6;

/// Fibre lines with a unit tangent at each point.
#[derive(Debug, Clone)]
pub(super) struct Courses {
    lines: Vec<Vec<Knot>>,
    /// mm².
    softening: f64,
}

#[derive(Debug, Clone, Copy)]
struct Knot {
    point: Vec3,
    tangent: Vec3,
}

impl Courses {
    /// Lines of two points or more, whose neighbouring points differ.
    pub fn new(lines: &[Vec<Vec3>]) -> Self {
        let length = |line: &Vec<Vec3>| line.windows(2).map(|w| (w[1] - w[0]).norm()).sum::<f64>();
        let mean = lines.iter().map(length).sum::<f64>() / lines.len() as f64;
        let lines = lines.iter().map(|line| knots(line, length(line))).collect();
        Self { lines, softening: (SOFTENING * mean).powi(2) }
    }

    /// The tangent of each line where it is nearest to `x`, with its weight: the inverse fourth
    /// power of the distance.
    pub fn tangents(&self, x: &Vec3) -> impl Iterator<Item = (Vec3, f64)> {
        self.lines.iter().map(|line| {
            let (squared, tangent) = nearest(line, x);
            (tangent, (squared + self.softening).powi(-2))
        })
    }
}

/// Tangents by the parabola through three points; a closed line goes on beyond its ends.
fn knots(line: &[Vec3], length: f64) -> Vec<Knot> {
    let last = line.len() - 1;
    let closed = last > 2 && (line[last] - line[0]).norm() <= CLOSED * length;
    let slope = |a: Vec3, b: Vec3, c: Vec3| {
        let (h, k) = ((b - a).norm(), (c - b).norm());
        ((b - a) * (k / h) + (c - b) * (h / k)) / (h + k)
    };
    let tangent = |i: usize| {
        let along = if i > 0 && i < last {
            slope(line[i - 1], line[i], line[i + 1])
        } else if closed {
            slope(line[last - 1], line[0], line[1])
        } else if last == 1 {
            line[1] - line[0]
        } else {
            let [a, b, c] =
                if i == 0 { [0, 1, 2] } else { [last, last - 1, last - 2] }.map(|k| line[k]);
            let chord = (b - a) / (b - a).norm();
            let at_end = chord * 2.0 - slope(a, b, c);
            if i == 0 { at_end } else { -at_end }
        };
        let size = along.norm();
        // Where the line turns back on itself the parabola has no tangent: its chord has.
        if size > 0.0 {
            along / size
        } else {
            (line[(i + 1).min(last)] - line[i.min(last - 1)]).normalize()
        }
    };
    (0..=last).map(|i| Knot { point: line[i], tangent: tangent(i) }).collect()
}

/// Squared distance to the line and its unit tangent there.
fn nearest(line: &[Knot], x: &Vec3) -> (f64, Vec3) {
    let (mut best, mut tangent) = (f64::INFINITY, line[0].tangent);
    for pair in line.windows(2) {
        let step = pair[1].point - pair[0].point;
        let from = x - pair[0].point;
        let t = (from.dot(&step) / step.norm_squared()).clamp(0.0, 1.0);
        let squared = (from - step * t).norm_squared();
        if squared < best {
            best = squared;
            tangent = pair[0].tangent * (1.0 - t) + pair[1].tangent * t;
        }
    }
    let size = tangent.norm();
    (best, if size > 0.0 { tangent / size } else { line[0].tangent })
}

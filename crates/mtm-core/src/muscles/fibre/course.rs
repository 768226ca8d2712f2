//! Fibre directions from known fibre lines.

use crate::vector::Vec3;

/// Distance within which a point counts as lying on a line, relative to the mean length of the lines: 0.4 mm on
/// a muscle of 40 mm.
const SOFTENING: f64 = 0.01;

/// A line counts as closed if its ends are closer to each other than this, relative to its length.
const CLOSED: f64 = 1e-6;

/// Relative margin on a distance within which a segment counts as near: far above rounding.
const NEAR_MARGIN: f64 = 1e-9;

/// Fibre lines with a unit tangent at each point.
#[derive(Debug, Clone)]
pub(super) struct Courses {
    all: Segments,
    /// mm².
    softening: f64,
}

/// Segments of fibre lines, line after line.
#[derive(Debug, Clone, Default)]
pub(super) struct Segments {
    list: Vec<LinePiece>,
    /// Where each line ends in the list; every line has at least one segment.
    ends: Vec<usize>,
}

/// A piece of a fibre line between two of its points.
#[derive(Debug, Clone, Copy)]
struct LinePiece {
    start: Vec3,
    step: Vec3,
    /// Squared length, mm².
    square: f64,
    /// Unit tangents at both ends.
    tangents: [Vec3; 2],
}

impl Courses {
    /// Lines of two points or more, in which neighbouring points differ.
    pub fn new(lines: &[Vec<Vec3>]) -> Self {
        let length = |line: &Vec<Vec3>| line.windows(2).map(|w| (w[1] - w[0]).norm()).sum::<f64>();
        let mean = lines.iter().map(length).sum::<f64>() / lines.len() as f64;
        let mut all = Segments::default();
        for line in lines {
            let tangents = tangents(line, length(line));
            all.list.extend(line.windows(2).zip(tangents.windows(2)).map(|(ends, tangents)| {
                let step = ends[1] - ends[0];
                let tangents = [tangents[0], tangents[1]];
                LinePiece { start: ends[0], step, square: step.norm_squared(), tangents }
            }));
            all.ends.push(all.list.len());
        }
        Self { all, softening: (SOFTENING * mean).powi(2) }
    }

    /// All segments of all lines.
    pub fn segments(&self) -> &Segments {
        &self.all
    }

    /// Writes into `near` the segments that may be the nearest of their line to a point of a ball.
    ///
    /// Segments further from the centre than the nearest by more than the ball's diameter cannot be.
    pub fn segments_near(&self, centre: &Vec3, radius: f64, near: &mut Segments) {
        near.list.clear();
        near.ends.clear();
        for line in self.all.lines() {
            let least =
                line.iter().map(|s| s.squared_distance(centre)).fold(f64::INFINITY, f64::min);
            let reach = (least.sqrt() + 2.0 * radius) * (1.0 + NEAR_MARGIN);
            let may_be = |s: &&LinePiece| s.squared_distance(centre) <= reach * reach;
            near.list.extend(line.iter().filter(may_be));
            near.ends.push(near.list.len());
        }
    }

    /// The tangent of each line where it is nearest to `x`, with its weight: the inverse fourth
    /// power of the distance. `segments` are all, or those near a ball that holds `x`.
    pub fn tangents<'a>(
        &'a self,
        segments: &'a Segments,
        x: &'a Vec3,
    ) -> impl Iterator<Item = (Vec3, f64)> + 'a {
        segments.lines().map(|line| {
            let (squared, tangent) = nearest(line, x);
            (tangent, (squared + self.softening).powi(-2))
        })
    }
}

impl Segments {
    fn lines(&self) -> impl Iterator<Item = &[LinePiece]> {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        starts.zip(&self.ends).map(|(start, &end)| &self.list[start..end])
    }
}

impl LinePiece {
    /// Position along the segment, as a share, at which it is nearest to a point.
    fn part(&self, from: &Vec3) -> f64 {
        (from.dot(&self.step) / self.square).clamp(0.0, 1.0)
    }

    fn squared_distance(&self, x: &Vec3) -> f64 {
        let from = x - self.start;
        (from - self.step * self.part(&from)).norm_squared()
    }
}

/// Tangents from the parabola through three points; a closed line continues beyond its ends.
fn tangents(line: &[Vec3], length: f64) -> Vec<Vec3> {
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
        // Where the line reverses its direction, the parabola has no tangent: that of its chord is used.
        if size > 0.0 {
            along / size
        } else {
            (line[(i + 1).min(last)] - line[i.min(last - 1)]).normalize()
        }
    };
    (0..=last).map(tangent).collect()
}

/// Squared distance to the nearest of a line's segments and the unit tangent there.
fn nearest(line: &[LinePiece], x: &Vec3) -> (f64, Vec3) {
    let (mut best, mut at, mut part) = (f64::INFINITY, 0, 0.0);
    for (i, segment) in line.iter().enumerate() {
        let from = x - segment.start;
        let t = segment.part(&from);
        let squared = (from - segment.step * t).norm_squared();
        if squared < best {
            (best, at, part) = (squared, i, t);
        }
    }
    let [first, second] = line[at].tangents;
    let tangent = first * (1.0 - part) + second * part;
    let size = tangent.norm();
    (best, if size > 0.0 { tangent / size } else { first })
}

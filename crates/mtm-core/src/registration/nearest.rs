//! The nearest of many points: a balanced k-d tree (Bentley 1975).

use crate::error::{ErrorKind, Result};
use crate::registration::spread::check_coordinates;

/// Number of points below which a box is not split: checking all of them is faster.
const LEAF_POINTS: usize = 8;

/// A set of points that can be searched for the point nearest to a position.
#[derive(Debug, Clone)]
pub struct PointTree {
    /// The points in the order of the tree: the middle one of a range splits it.
    points: Vec<[f64; 3]>,
    /// Their indices in the original order.
    index: Vec<u32>,
    /// Axis along which the range with this middle is split.
    axis: Vec<u8>,
}

/// The nearest point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Its index; of several equally near ones, the smallest.
    pub index: u32,
    /// Its position, mm.
    pub point: [f64; 3],
    /// Its squared distance, mm².
    pub squared: f64,
}

impl PointTree {
    /// Tree of `points` (mm).
    ///
    /// # Errors
    /// `Empty`, `NotFinite`, `OutOfRange`.
    pub fn new(points: &[[f64; 3]]) -> Result<Self> {
        ErrorKind::Registration.require_entries("fixed points", points.len())?;
        check_coordinates("fixed", points)?;
        let mut index: Vec<u32> = (0..points.len() as u32).collect();
        let mut axis = vec![0; points.len()];
        part(points, &mut index, &mut axis);
        let sorted = index.iter().map(|&i| points[i as usize]).collect();
        Ok(Self { points: sorted, index, axis })
    }

    /// The nearest point to the position `place` (mm, finite).
    pub fn nearest(&self, place: [f64; 3]) -> Nearest {
        let mut best = Nearest { index: u32::MAX, point: [0.0; 3], squared: f64::INFINITY };
        self.search(0, self.points.len(), &place, &mut best);
        best
    }

    fn search(&self, low: usize, high: usize, place: &[f64; 3], best: &mut Nearest) {
        if high - low <= LEAF_POINTS {
            (low..high).for_each(|at| self.compare(at, place, best));
            return;
        }
        let middle = low.midpoint(high);
        let axis = self.axis[middle] as usize;
        let beyond = place[axis] - self.points[middle][axis];
        let (near, far) = if beyond < 0.0 {
            ((low, middle), (middle + 1, high))
        } else {
            ((middle + 1, high), (low, middle))
        };
        self.search(near.0, near.1, place, best);
        self.compare(middle, place, best);
        // Equal distances are checked as well: the smallest index wins.
        if beyond * beyond <= best.squared {
            self.search(far.0, far.1, place, best);
        }
    }

    fn compare(&self, at: usize, place: &[f64; 3], best: &mut Nearest) {
        let point = self.points[at];
        let [x, y, z] = [0, 1, 2].map(|axis| place[axis] - point[axis]);
        let squared = x * x + y * y + z * z;
        let index = self.index[at];
        if squared < best.squared || (squared == best.squared && index < best.index) {
            *best = Nearest { index, point, squared };
        }
    }
}

/// Orders `index` so that the middle splits the range along its longest axis, and each half likewise.
fn part(points: &[[f64; 3]], index: &mut [u32], axis: &mut [u8]) {
    if index.len() <= LEAF_POINTS {
        return;
    }
    let coordinate = |i: u32, a: usize| points[i as usize][a];
    let extent = |a: usize| {
        let (low, high) = index.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &i| {
            (l.min(coordinate(i, a)), h.max(coordinate(i, a)))
        });
        high - low
    };
    let extents = [extent(0), extent(1), extent(2)];
    let longest = (1..3).fold(0, |best, a| if extents[a] > extents[best] { a } else { best });
    let middle = 0_usize.midpoint(index.len());
    index.select_nth_unstable_by(middle, |&i, &j| {
        coordinate(i, longest).total_cmp(&coordinate(j, longest)).then(i.cmp(&j))
    });
    axis[middle] = longest as u8;
    let (low, rest) = index.split_at_mut(middle);
    let (low_axis, rest_axis) = axis.split_at_mut(middle);
    part(points, low, low_axis);
    part(points, &mut rest[1..], &mut rest_axis[1..]);
}

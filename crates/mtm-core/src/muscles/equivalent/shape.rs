//! A muscle's surface prepared for many queries: triangles with their boxes, border, winding tree.

use crate::geometry::surface::Surface;
use crate::geometry::winding::{BETA, WindingTree};
use crate::muscles::equivalent::aligned_box::AlignedBox;
use crate::muscles::equivalent::border::Border;
use crate::vector::Vec3;

/// Winding number that separates inside from outside.
const INSIDE: f64 = 0.5;
/// Error of a hierarchical winding number, with a margin: the tests hold it below half of this.
const WINDING_ERROR: f64 = 0.02;

/// As [`BETA`], of a surface without a border: its winding number is an integer, so that an error
/// of a tenth is as good as one of a hundredth.
const CLOSED_BETA: f64 = 1.4;

/// How a point is classified as inside a muscle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum InsideTest {
    /// The generalised winding number exceeds one half (Barill et al. 2018): correct even if the surface
    /// overlaps itself, has small holes or a few flipped triangles.
    #[default]
    Winding,
    /// The normal at the closest point of the surface points away from the point (Kim et al. 2010, section
    /// 2.3): correct for closed surfaces that do not overlap themselves.
    Normal,
}

/// Where a region lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    Inside,
    Outside,
    /// Possibly on both sides: next to a hole, a level of the winding number separates them, not a triangle.
    Mixed,
}

/// A muscle's surface with the data for the inside tests.
#[derive(Debug)]
pub struct MuscleShape<'a> {
    surface: &'a Surface,
    pub(super) corners: Vec<[Vec3; 3]>,
    /// Of each triangle.
    pub(super) boxes: Vec<AlignedBox>,
    /// Around the whole surface: no point outside it counts as inside.
    pub(super) bounds: AlignedBox,
    border: Border,
    tree: WindingTree,
    /// Volume between the triangles and the centre of their box, mm³.
    signed_volume: f64,
    /// −1 for a surface that is inside out, whose normals are reversed; otherwise 1.
    pub orientation: f64,
    pub(super) test: InsideTest,
}

impl<'a> MuscleShape<'a> {
    /// Of `surface`, for `test`.
    pub fn new(surface: &'a Surface, test: InsideTest) -> Self {
        let n = surface.triangles().len();
        let corners: Vec<[Vec3; 3]> = (0..n).map(|t| surface.corners(t)).collect();
        let boxes: Vec<AlignedBox> = corners.iter().map(|c| AlignedBox::of(c)).collect();
        let bounds = boxes.iter().fold(AlignedBox::EMPTY, |all, one| all.joined(one));
        let signed_volume = signed_volume(&corners, &bounds.centre());
        let orientation = if signed_volume < 0.0 { -1.0 } else { 1.0 };
        let border = Border::new(surface);
        let beta = if border.is_empty() { CLOSED_BETA } else { BETA };
        let tree = WindingTree::with_beta(surface, beta).expect("both betas are allowed");
        Self { surface, corners, boxes, bounds, border, tree, signed_volume, orientation, test }
    }

    /// Volume that the surface encloses, mm³; none if it has a border. Vertices at the same position are
    /// identified.
    pub fn enclosed(&self) -> Option<f64> {
        self.border.is_empty().then_some(self.signed_volume.abs())
    }

    /// Winding number at `p`, positive inside whatever the orientation of the triangles; an integer if the
    /// surface has no border.
    pub fn winding(&self, p: &Vec3) -> f64 {
        let w = self.unrounded_winding(p);
        if self.border.is_empty() { w.round() } else { w }
    }

    /// The same as computed by the tree.
    pub fn unrounded_winding(&self, p: &Vec3) -> f64 {
        self.orientation * self.tree.winding_number_one((*p).into())
    }

    /// Whether `p` lies inside, by one evaluation of the chosen test.
    pub fn holds(&self, p: &Vec3) -> bool {
        match self.test {
            InsideTest::Winding => is_inside(self.winding(p)),
            InsideTest::Normal => {
                let closest = self.surface.closest_one((*p).into());
                let to_surface = Vec3::from(closest.point) - p;
                self.orientation * to_surface.dot(&Vec3::from(closest.normal)) > 0.0
            }
        }
    }

    /// Side of a ball that no triangle meets, by one evaluation at its centre.
    ///
    /// The closest normal does not show where its answer changes: it is used for the whole ball.
    pub fn side_of(&self, centre: &Vec3, radius: f64) -> Side {
        let is_inside = match self.test {
            InsideTest::Winding => {
                let w = self.winding(centre);
                if !self.is_settled(w, centre, radius) {
                    return Side::Mixed;
                }
                is_inside(w)
            }
            InsideTest::Normal => self.holds(centre),
        };
        if is_inside { Side::Inside } else { Side::Outside }
    }

    /// Whether a winding number `w` at `centre`, updated by the crossings of the surface, decides for every
    /// point of the ball as the exact winding number there would.
    pub fn is_settled(&self, w: f64, centre: &Vec3, radius: f64) -> bool {
        if self.border.is_empty() {
            return true;
        }
        // Crossings change w by integers: only the distance of w from ½ modulo 1 matters.
        let margin = ((w - INSIDE) - (w - INSIDE).round()).abs() - WINDING_ERROR;
        margin > 0.0 && self.border.change_within(centre, radius, margin) < margin
    }
}

/// Whether a winding number is that of a point inside.
pub(super) fn is_inside(winding: f64) -> bool {
    winding > INSIDE
}

/// Volume between the triangles and `apex`, positive where they face away from it.
fn signed_volume(corners: &[[Vec3; 3]], apex: &Vec3) -> f64 {
    corners.iter().map(|[a, b, c]| (a - apex).dot(&(b - apex).cross(&(c - apex)))).sum::<f64>()
        / 6.0
}

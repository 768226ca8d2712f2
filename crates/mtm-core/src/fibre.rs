//! Fibre directions of a muscle, from oriented boxes of its surface (Kim et al. 2010, section 2.2).

use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};

/// Where the fibres of a muscle run: its oriented boxes, each with one direction.
#[derive(Debug, Clone)]
pub struct MuscleFibres {
    boxes: Vec<OrientedBox>,
}

/// A box along the principal axes of a part of a muscle's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBox {
    /// Its centre, mm.
    pub centre: [f64; 3],
    /// Unit axes, right-handed; the fibres run along the first.
    pub axes: [[f64; 3]; 3],
    /// Half of its extent along each axis, mm.
    pub half_extents: [f64; 3],
}

impl MuscleFibres {
    /// Fibres that run along the first axis of the nearest of `boxes`.
    ///
    /// # Errors
    /// [`MtmError::Empty`] without a box; [`MtmError::NotFinite`] for a centre that is NaN or infinite.
    pub fn from_boxes(boxes: Vec<OrientedBox>) -> Result<Self> {
        if boxes.is_empty() {
            return Err(MtmError::Empty { what: "fibre boxes", kind: ErrorKind::Mesh });
        }
        let centres: Vec<[f64; 3]> = boxes.iter().map(|b| b.centre).collect();
        check_finite_rows("fibre box centre", &centres, ErrorKind::Mesh)?;
        Ok(Self { boxes })
    }

    /// The boxes.
    pub fn boxes(&self) -> &[OrientedBox] {
        &self.boxes
    }

    /// Unit direction of the fibres at `point` (mm, finite); its sign means nothing.
    pub fn direction(&self, point: [f64; 3]) -> [f64; 3] {
        let distance =
            |b: &OrientedBox| (0..3).map(|i| (point[i] - b.centre[i]).powi(2)).sum::<f64>();
        self.boxes
            .iter()
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))
            .map_or([1.0, 0.0, 0.0], |nearest| nearest.axes[0])
    }
}

//! Facial muscles of the generated shell: bands of oriented boxes and the part of each tet they fill.

use super::{Vec3, add_scaled, cross, dot, skull_normal, tissue_point, unit};

/// Sample points per tet. Fractions are multiples of its inverse: eleven materials at most.
const SAMPLES: usize = 10;

/// A muscle: its course, (longitude, latitude) in degrees on the left side, and its cross-section.
struct Band {
    course: &'static [(f64, f64)],
    /// Along the skin, mm.
    width: f64,
    /// Through the tissue, mm.
    thickness: f64,
    /// Of the centre line: 0 on the bone, 1 on the skin.
    depth: f64,
}

const fn band(course: &'static [(f64, f64)], width: f64, thickness: f64, depth: f64) -> Band {
    Band { course, width, thickness, depth }
}

/// Muscles of one side of the face; the other side mirrors them.
#[rustfmt::skip]
const BANDS: [Band; 12] = [
    // masseter
    band(&[(59.0, -1.0), (63.0, -19.0), (65.0, -38.0)], 24.0, 9.0, 0.40),
    // zygomaticus major and minor
    band(&[(46.0, 2.0), (34.0, -9.0), (19.0, -19.0)], 8.0, 4.0, 0.60),
    band(&[(37.0, 5.0), (25.0, -5.0), (12.0, -13.0)], 6.0, 3.5, 0.60),
    // levator labii superioris
    band(&[(21.0, 11.0), (16.0, 0.0), (9.0, -12.0)], 10.0, 4.0, 0.55),
    // buccinator
    band(&[(64.0, -14.0), (43.0, -18.0), (19.0, -20.0)], 16.0, 4.0, 0.22),
    // risorius
    band(&[(52.0, -22.0), (36.0, -21.0), (20.0, -20.0)], 7.0, 3.0, 0.70),
    // depressor anguli oris, depressor labii inferioris
    band(&[(29.0, -44.0), (25.0, -33.0), (19.0, -22.0)], 12.0, 4.0, 0.55),
    band(&[(17.0, -44.0), (12.0, -36.0), (7.0, -28.0)], 10.0, 4.0, 0.45),
    // mentalis
    band(&[(4.0, -33.0), (5.0, -41.0), (5.0, -47.0)], 8.0, 6.0, 0.40),
    // orbicularis oris, upper and lower lip
    band(&[(0.0, -15.0), (10.0, -16.0), (18.0, -20.0)], 8.0, 5.0, 0.60),
    band(&[(0.0, -27.0), (10.0, -25.0), (18.0, -20.0)], 8.0, 5.0, 0.60),
    // frontalis
    band(&[(13.0, 18.0), (14.0, 30.0), (15.0, 42.0)], 22.0, 3.0, 0.50),
];

/// An oriented box of muscle; the first axis is the fibre direction.
pub(super) struct MuscleBox {
    centre: Vec3,
    axes: [Vec3; 3],
    half: Vec3,
}

/// One box for each straight piece of each band, both sides.
pub(super) fn muscle_boxes() -> Vec<MuscleBox> {
    let mut boxes = Vec::new();
    for band in &BANDS {
        for (side, piece) in [1.0, -1.0]
            .into_iter()
            .flat_map(|side| band.course.windows(2).map(move |piece| (side, piece)))
        {
            let [start, end] =
                [piece[0], piece[1]].map(|(lon, lat)| tissue_point(side * lon, lat, band.depth));
            let normal = skull_normal(
                side * (piece[0].0 + piece[1].0) / 2.0,
                (piece[0].1 + piece[1].1) / 2.0,
            );
            let run = add_scaled(end, -1.0, start);
            let along = unit(run);
            let through = unit(add_scaled(normal, -dot(normal, along), along));
            boxes.push(MuscleBox {
                centre: add_scaled(start, 0.5, run),
                axes: [along, cross(through, along), through],
                half: [dot(run, along) / 2.0, band.width / 2.0, band.thickness / 2.0],
            });
        }
    }
    boxes
}

/// Muscle fraction and fibre of each tet: the part of its sample points in any box, and the direction
/// of the box with most.
pub(super) fn sample_muscles(
    nodes: &[Vec3],
    tets: &[[u32; 4]],
    boxes: &[MuscleBox],
) -> (Vec<f64>, Vec<Vec3>) {
    let weights = sample_weights();
    let reach: Vec<f64> = boxes.iter().map(|b| dot(b.half, b.half).sqrt()).collect();
    let sample = |tet: &[u32; 4]| {
        let corners = tet.map(|node| nodes[node as usize]);
        let centre = weighted(&corners, &[0.25; 4]);
        let radius = corners.iter().map(|&x| distance(x, centre)).fold(0.0, f64::max);
        let (mut hit, mut most, mut fibre) = ([false; SAMPLES], 0, [0.0, 0.0, 1.0]);
        for (muscle, _) in
            boxes.iter().zip(&reach).filter(|(b, r)| distance(b.centre, centre) < radius + **r)
        {
            let mut count = 0;
            for (sample, weight) in weights.iter().enumerate() {
                let d = add_scaled(weighted(&corners, weight), -1.0, muscle.centre);
                if (0..3).all(|axis| dot(d, muscle.axes[axis]).abs() <= muscle.half[axis]) {
                    hit[sample] = true;
                    count += 1;
                }
            }
            if count > most {
                (most, fibre) = (count, muscle.axes[0]);
            }
        }
        (hit.iter().filter(|&&h| h).count() as f64 / SAMPLES as f64, fibre)
    };
    tets.iter().map(sample).unzip()
}

/// Barycentric weights of points spread evenly in a tet: a Kronecker sequence in the unit cube (steps
/// 1/φ, 1/φ², 1/φ³ with φ⁴ = φ + 1), whose sorted coordinates cut [0, 1] into the four weights.
fn sample_weights() -> [[f64; 4]; SAMPLES] {
    const PHI: f64 = 1.220_744_084_605_759_5;
    std::array::from_fn(|sample| {
        let mut cut = [1, 2, 3].map(|power| (0.5 + (sample + 1) as f64 * PHI.powi(-power)).fract());
        cut.sort_by(f64::total_cmp);
        [cut[0], cut[1] - cut[0], cut[2] - cut[1], 1.0 - cut[2]]
    })
}

fn weighted(corners: &[Vec3; 4], weights: &[f64; 4]) -> Vec3 {
    corners.iter().zip(weights).fold([0.0; 3], |sum, (&x, &w)| add_scaled(sum, w, x))
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    let d = add_scaled(a, -1.0, b);
    dot(d, d).sqrt()
}

//! What springs of negative stiffness do to a body: which of them carry it on, and how far.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::krylov::Operator;
use crate::contact::Spring;
use crate::vector::{add, dot, norm, scaled};

/// Share of the stiffness of the body along a direction that springs may cancel: if they cancel more, some of
/// them are left out of the step.
const LEFT_SHARE: f64 = 0.5;

/// Removes from `springs` those that make the body unstable along `direction`: the strongest first, until the
/// rest cancel at most half of the stiffness of the body.
pub fn at_fault(
    matrix: &BlockMatrix,
    springs: &mut Vec<(usize, Spring)>,
    direction: &[[f64; 3]],
) -> Vec<(usize, Spring)> {
    let work = |(row, s): &(usize, Spring)| s.stiffness * dot(s.axis, direction[*row]).powi(2);
    let mut product = vec![[0.0; 3]; direction.len()];
    matrix.multiply_into(direction, &mut product);
    let mut held: f64 = direction.iter().zip(&product).map(|(d, p)| dot(*d, *p)).sum();
    held += springs.iter().map(|s| work(s).max(0.0)).sum::<f64>();
    let mut order: Vec<usize> =
        (0..springs.len()).filter(|&k| springs[k].1.stiffness < 0.0).collect();
    order.sort_by(|&a, &b| work(&springs[a]).total_cmp(&work(&springs[b])));
    let mut carried: f64 = -order.iter().map(|&k| work(&springs[k])).sum::<f64>();
    let mut out = vec![false; springs.len()];
    for k in order {
        if carried <= LEFT_SHARE * held && out.contains(&true) {
            break;
        }
        carried += work(&springs[k]);
        out[k] = true;
    }
    let mut kept = out.iter().map(|out| !out);
    let taken = springs.iter().zip(&out).filter(|(_, out)| **out).map(|(s, _)| *s).collect();
    springs.retain(|_| kept.next().unwrap_or(true));
    taken
}

/// Adds to x the multiple of each of `directions` that decreases ½ xᵀ A x − bᵀ x the most, moving no node by
/// more than `reach`; returns whether there is no minimum along one of them.
pub fn carry_on(
    a: &dyn Operator,
    b: &[[f64; 3]],
    directions: &[Vec<[f64; 3]>],
    reach: f64,
    x: &mut [[f64; 3]],
) -> bool {
    let work =
        |u: &[[f64; 3]], f: &[[f64; 3]]| -> f64 { u.iter().zip(f).map(|(u, f)| dot(*u, *f)).sum() };
    let mut product = vec![[0.0; 3]; b.len()];
    let mut is_carried = false;
    for direction in directions {
        a.multiply_into(x, &mut product);
        let slope = work(direction, &product) - work(direction, b);
        a.multiply_into(direction, &mut product);
        let curvature = work(direction, &product);
        let largest = direction.iter().fold(0.0_f64, |m, d| m.max(norm(*d)));
        let way = way_along(slope, curvature, reach / largest);
        is_carried |= curvature <= 0.0;
        for (x, d) in x.iter_mut().zip(direction) {
            *x = add(*x, scaled(*d, way));
        }
    }
    is_carried
}

/// How far to go along a direction, given the `slope` and `curvature` of the energy at its start: to the
/// minimum, or by `most` downhill if there is none.
fn way_along(slope: f64, curvature: f64, most: f64) -> f64 {
    if curvature > 0.0 {
        return (-slope / curvature).clamp(-most, most);
    }
    if slope > 0.0 { -most } else { most }
}

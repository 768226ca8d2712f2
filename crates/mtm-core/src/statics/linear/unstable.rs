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
pub(crate) fn at_fault(
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
pub(crate) fn carry_on(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statics::linear::projected_product::ProjectedProduct;

    fn spring(row: usize, stiffness: f64) -> (usize, Spring) {
        (row, Spring { node: row, axis: [1.0, 0.0, 0.0], stiffness, goal: 0.0 })
    }

    /// Three independent rows, each with a stiffness of 1 N/mm.
    fn unit() -> BlockMatrix {
        let mut matrix = BlockMatrix::from_pattern(vec![0, 1, 2, 3], vec![0, 1, 2]);
        for block in &mut matrix.blocks {
            *block = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        }
        matrix
    }

    #[test]
    fn the_strongest_springs_are_left_out_of_a_direction_that_gives_way() {
        let mut springs = vec![spring(0, -0.3), spring(1, -2.5), spring(2, 0.5), spring(2, -0.1)];
        let out = at_fault(&unit(), &mut springs, &[[1.0, 0.0, 0.0]; 3]);
        assert_eq!(out.iter().map(|(row, _)| *row).collect::<Vec<_>>(), [1]);
        assert_eq!(springs.len(), 3);
    }

    #[test]
    fn a_body_is_carried_on_to_its_minimum_or_as_far_as_springs_reach() {
        let (matrix, along_x) = (unit(), vec![[1.0, 0.0, 0.0], [0.0; 3], [0.0; 3]]);
        let b = vec![[0.3, 0.0, 0.0], [0.0; 3], [0.0; 3]];
        let mut x = vec![[0.0; 3]; 3];
        let held = [spring(0, -0.4)];
        let product = ProjectedProduct::new(&matrix, &[], &held);
        assert!(!carry_on(&product, &b, std::slice::from_ref(&along_x), 2.0, &mut x));
        assert!((x[0][0] - 0.5).abs() < 1e-14, "{x:?}");
        // Beyond the top of a hill, downhill is ahead; before it, downhill is back.
        let unheld = [spring(0, -1.4)];
        let product = ProjectedProduct::new(&matrix, &[], &unheld);
        for (start, end) in [(-0.7, 1.3), (-0.8, -2.8)] {
            x[0][0] = start;
            assert!(carry_on(&product, &b, std::slice::from_ref(&along_x), 2.0, &mut x));
            assert!((x[0][0] - end).abs() < 1e-14, "{x:?}");
        }
    }
}

//! Rotation and stretch of a deformation gradient, also defined for inverted tets.

use nalgebra::{Matrix3, Vector3};

/// F = Q Σ Vᵀ with rotations Q and V: R = Q Vᵀ is the rotation nearest to F, U = V Σ Vᵀ its stretch.
///
/// If F inverts, the smallest stretch is negative, and R is still a proper rotation (Irving, Teran & Fedkiw
/// 2004).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Polar {
    /// Principal directions after the deformation.
    pub q: Matrix3<f64>,
    /// Principal directions at rest.
    pub v: Matrix3<f64>,
    /// Principal stretches.
    pub stretch: Vector3<f64>,
}

impl Polar {
    /// The decomposition of `f`; the stretches are NaN if an entry of `f` is not finite.
    pub fn new(f: &Matrix3<f64>) -> Self {
        // The singular value iteration would not terminate.
        if f.iter().any(|x| !x.is_finite()) {
            let (q, v) = (Matrix3::identity(), Matrix3::identity());
            return Self { q, v, stretch: Vector3::repeat(f64::NAN) };
        }
        let svd = f.svd_unordered(true, true);
        let (Some(mut q), Some(vt)) = (svd.u, svd.v_t) else {
            unreachable!("both sets of singular vectors were asked for")
        };
        let (mut v, mut stretch) = (vt.transpose(), svd.singular_values);
        let smallest = stretch.imin();
        for turned in [&mut q, &mut v] {
            if turned.determinant() < 0.0 {
                let mirrored = -turned.column(smallest);
                turned.set_column(smallest, &mirrored);
                stretch[smallest] = -stretch[smallest];
            }
        }
        Self { q, v, stretch }
    }

    /// R.
    pub fn rotation(&self) -> Matrix3<f64> {
        self.q * self.v.transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factors_compose_to_the_gradient_and_the_rotation_never_mirrors() {
        let shear = Matrix3::new(1.2, 0.3, -0.1, 0.05, 0.9, 0.2, 0.1, -0.2, 1.1);
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -0.3));
        let flat = Matrix3::from_diagonal(&Vector3::new(1.0, 2.0, 0.0));
        for f in [shear, shear * mirror, flat, -shear, Matrix3::identity(), Matrix3::zeros()] {
            let p = Polar::new(&f);
            let back = p.q * Matrix3::from_diagonal(&p.stretch) * p.v.transpose();
            assert!((back - f).amax() < 1e-14, "{f} {back}");
            for turn in [p.q, p.v, p.rotation()] {
                assert!((turn.transpose() * turn - Matrix3::identity()).amax() < 1e-14);
                assert!((turn.determinant() - 1.0).abs() < 1e-14);
            }
        }
    }
}

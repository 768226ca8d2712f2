//! Strain energy of a material point under large rotation: value, stress and tangent by the deformation
//! gradient F. Energies in MPa = N mm/mm³.
//!
//! Corotational: W = ½ e : C : e with the stretch e = U − I of F = R U (Biot 1965). For isotropic C its force
//! is the corotational one, R K (Rᵀ x − X) (Müller & Gross 2004); for a fibre it is the one derived from an
//! energy, and exerts no net moment.
//!
//! Hyperelastic: a law of isotropic tissue for the isotropic stiffness nearest to C (Fedorov 1968), plus ½ e :
//! (C − C_iso) : e for the fibre. At F = I the tangent is C.

use nalgebra::{Cholesky, Matrix3, Matrix6, SVector, SymmetricEigen, Vector3};

use crate::mechanics::hyperelastic::{PointResponse, Tangent, cofactor};
use crate::mechanics::kinematics::Kinematics;
use crate::mechanics::material::{Lame, PAIRS, Voigt, voigt_matrix};
use crate::mechanics::polar::{Polar, small_tangent};
use crate::mechanics::tissue::TetMaterial;

/// Sum of two principal stretches below which the rotation about the third axis is undefined: the tet is almost
/// completely inverted.
const LEAST_STRETCH_SUM: f64 = 1e-2;
/// Stiffness added to a tangent, relative to its largest entry, so that its zero eigenvalues, such as those of
/// rotations at rest, do not become negative by rounding. Newton's method converges as fast with it.
const DEFINITE_LIFT: f64 = 1e-10;
/// A deformation, row by row.
type Mode = SVector<f64, 9>;
/// Index in Voigt order of each entry of a tensor, row by row.
const VOIGT: [usize; 9] = [0, 5, 4, 5, 1, 3, 4, 3, 2];

/// Energy density of one material.
#[derive(Debug, Clone, Copy)]
pub struct Density {
    /// Constants of its hyperelastic part, whose law is that of the kinematics.
    isotropic: Option<Lame>,
    stretch: Option<Stiffness>,
}

/// C for the stretch energy, stored without a box, since it is read at every point.
#[derive(Debug, Clone, Copy)]
#[allow(clippy::large_enum_variant)]
enum Stiffness {
    Isotropic(Lame),
    General(Voigt),
}

/// A volumetric measure at a point: θ and ∂θ/∂F.
#[derive(Debug, Clone, Copy)]
pub struct Volumetric {
    /// tr U − 3 (corotational) or J − 1 (hyperelastic).
    pub value: f64,
    /// R or the cofactor of F.
    pub slope: Matrix3<f64>,
}

impl Density {
    /// The energy of `material` under `kinematics`, which must not be linear.
    pub fn new(material: &TetMaterial<'_>, kinematics: Kinematics) -> Self {
        let stiffness = match material {
            TetMaterial::Isotropic(lame) => Stiffness::Isotropic(*lame),
            other => Stiffness::General(other.voigt()),
        };
        match (kinematics, stiffness) {
            (Kinematics::Linear | Kinematics::Corotational, _) => {
                Self { isotropic: None, stretch: Some(stiffness) }
            }
            (Kinematics::Hyperelastic(_), Stiffness::Isotropic(lame)) => {
                Self { isotropic: Some(lame), stretch: None }
            }
            (Kinematics::Hyperelastic(_), Stiffness::General(c)) => {
                let lame = nearest_isotropic(&c);
                let mut rest = c;
                for (i, row) in rest.iter_mut().enumerate() {
                    row[i] -= if i < 3 { 2.0 * lame.mu } else { lame.mu };
                    for value in row.iter_mut().take(if i < 3 { 3 } else { 0 }) {
                        *value -= lame.lambda_;
                    }
                }
                let stretch = Some(Stiffness::General(rest));
                Self { isotropic: Some(lame), stretch }
            }
        }
    }

    /// Energy and stress at `f`; `pressure` on the volumetric measure of `kinematics` is added to the stress.
    pub fn response(
        &self,
        f: &Matrix3<f64>,
        kinematics: Kinematics,
        pressure: f64,
    ) -> PointResponse {
        let mut out = match (kinematics, &self.isotropic) {
            (Kinematics::Hyperelastic(law), Some(lame)) => law.response(*lame, f),
            _ => PointResponse { energy: 0.0, stress: Matrix3::zeros() },
        };
        if let Some(stiffness) = &self.stretch {
            let polar = Polar::new(f);
            let strain = stretch_strain(&polar);
            let t = stiffness.apply(&strain);
            out.energy += 0.5 * t.dot(&strain);
            out.stress += polar.q * in_frame_stress(&polar, &t) * polar.v.transpose();
        }
        if pressure != 0.0 {
            out.stress += volumetric(f, kinematics).slope * pressure;
        }
        out
    }

    /// ∂²W/∂F² at `f`, with `pressure` times that of the volumetric measure.
    pub fn tangent(&self, f: &Matrix3<f64>, kinematics: Kinematics, pressure: f64) -> Tangent {
        let [of_law, of_stretch] = self.tangents(f, kinematics, pressure);
        of_law + of_stretch
    }

    /// Its parts: of the law with the volumetric measure of hyperelastic tissue, and of the stretch energy.
    fn tangents(&self, f: &Matrix3<f64>, kinematics: Kinematics, pressure: f64) -> [Tangent; 2] {
        let (mut of_law, mut of_stretch) = (Tangent::zeros(), Tangent::zeros());
        let (mut cofactor_stress, stretch_pressure) = match kinematics {
            Kinematics::Hyperelastic(_) => (pressure, 0.0),
            Kinematics::Linear | Kinematics::Corotational => (0.0, pressure),
        };
        if let (Kinematics::Hyperelastic(law), Some(lame)) = (kinematics, &self.isotropic) {
            let found = law.tangent(*lame, f);
            of_law = found.own;
            cofactor_stress += found.cofactor_stress;
        }
        if cofactor_stress != 0.0 {
            add_cofactor_tangent(&mut of_law, f, cofactor_stress);
        }
        if let Some(stiffness) = &self.stretch {
            of_stretch = stretch_tangent(stiffness, f, stretch_pressure);
        }
        [of_law, of_stretch]
    }

    /// A tangent at `f` without negative curvature: steps computed with it go downhill.
    ///
    /// Most points have none: a Cholesky factorisation with a small shift shows that, and the shifted tangent is
    /// the answer. Otherwise negative curvature is replaced in the isotropic part, which is cheap, and in the
    /// whole where that is not enough.
    pub fn definite(&self, f: &Matrix3<f64>, kinematics: Kinematics, pressure: f64) -> Tangent {
        let [of_law, of_stretch] = self.tangents(f, kinematics, pressure);
        let tangent = of_law + of_stretch;
        // The eigenvalue iteration would not terminate.
        if tangent.iter().any(|x| !x.is_finite()) {
            return tangent;
        }
        if let Some(lifted) = lifted_if_definite(&tangent) {
            return lifted;
        }
        if !matches!(self.stretch, Some(Stiffness::General(_))) {
            return without_negative_isotropic(&tangent, f, kinematics);
        }
        let partly = || without_negative_isotropic(&of_law, f, kinematics) + of_stretch;
        self.isotropic
            .and_then(|_| lifted_if_definite(&partly()))
            .unwrap_or_else(|| without_negative(&symmetric(&tangent), kinematics))
    }
}

/// The part of `tangent` that is equal to its transpose: all but rounding errors.
fn symmetric(tangent: &Tangent) -> Tangent {
    0.5 * (tangent + tangent.transpose())
}

/// `tangent` with a small shift, if that is positive definite.
fn lifted_if_definite(tangent: &Tangent) -> Option<Tangent> {
    let symmetric = symmetric(tangent);
    let lifted = symmetric + Tangent::identity() * (DEFINITE_LIFT * symmetric.amax());
    Cholesky::new(lifted).map(|_| lifted)
}

/// θ and ∂θ/∂F of `kinematics` at `f`.
pub fn volumetric(f: &Matrix3<f64>, kinematics: Kinematics) -> Volumetric {
    match kinematics {
        Kinematics::Hyperelastic(_) => {
            Volumetric { value: f.determinant() - 1.0, slope: cofactor(f) }
        }
        Kinematics::Linear | Kinematics::Corotational => {
            let polar = Polar::new(f);
            Volumetric { value: polar.stretch.sum() - 3.0, slope: polar.rotation() }
        }
    }
}

/// Curvature kept in place of `value`, which may be negative.
///
/// For hyperelastic points negative curvature is replaced by its absolute value, so that steps stay as short
/// along it as along positive curvature (Chen et al. 2024); without it they would overshoot. For corotational
/// points it is removed (Teran et al. 2005): it comes from rotations far from rest, which short steps would not
/// complete.
fn kept_curvature(value: f64, kinematics: Kinematics) -> f64 {
    match kinematics {
        Kinematics::Hyperelastic(_) => value.abs(),
        Kinematics::Linear | Kinematics::Corotational => value.max(0.0),
    }
}

/// The symmetric `tangent` with the curvature that is kept along each of its eigenvectors.
pub fn without_negative(tangent: &Tangent, kinematics: Kinematics) -> Tangent {
    let eigen = SymmetricEigen::new(*tangent);
    let mut out = Tangent::zeros();
    for i in 0..9 {
        let mode = eigen.eigenvectors.column(i);
        out += mode * mode.transpose() * kept_curvature(eigen.eigenvalues[i], kinematics);
    }
    out
}

/// [`without_negative`] for isotropic tissue at `f`: in the principal axes its tangent consists of one block for
/// the three stretches and one for each pair of axes (Smith, de Goes & Kim 2019). Only the modes of negative
/// curvature are changed: they are few, and a whole tangent in other axes costs more than all of them.
fn without_negative_isotropic(
    tangent: &Tangent,
    f: &Matrix3<f64>,
    kinematics: Kinematics,
) -> Tangent {
    let polar = Polar::new(f);
    // δF of a unit entry of A = Qᵀ δF V.
    let mode =
        |t: usize, u: usize| Mode::from_fn(|kl, _| polar.q[(kl / 3, t)] * polar.v[(kl % 3, u)]);
    let mut kept = symmetric(tangent);
    kept += Tangent::identity() * (DEFINITE_LIFT * kept.amax());
    let mut replace = |value: f64, mode: Mode| {
        let change = kept_curvature(value, kinematics) - value;
        if change > 0.0 {
            kept += mode * (mode * change).transpose();
        }
    };
    let stretches: [Mode; 3] = std::array::from_fn(|i| mode(i, i));
    let curved = stretches.map(|mode| tangent * mode);
    let block = Matrix3::from_fn(|i, j| stretches[i].dot(&curved[j]));
    // Negative curvature usually comes from turns, not from stretches.
    if Cholesky::new(block).is_none() {
        let eigen = SymmetricEigen::new(block);
        for (&value, weights) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            let [a, b, c] = stretches;
            replace(value, a * weights[0] + b * weights[1] + c * weights[2]);
        }
    }
    for (i, j) in [(0, 1), (0, 2), (1, 2)] {
        let (a, b) = (mode(i, j), mode(j, i));
        let curved = tangent * b;
        let (own, other, mixed) = (a.dot(&(tangent * a)), b.dot(&curved), a.dot(&curved));
        let t = if mixed == 0.0 { 0.0 } else { small_tangent(0.5 * (other - own) / mixed) };
        let size = 1.0 / (1.0 + t * t).sqrt();
        replace(own - t * mixed, (a - b * t) * size);
        replace(other + t * mixed, (a * t + b) * size);
    }
    kept
}

/// The isotropic stiffness nearest to `c` (Fedorov 1968): 9K = C_iijj, 30 μ = 3 C_ijij − C_iijj.
fn nearest_isotropic(c: &Voigt) -> Lame {
    let mut volume = 0.0;
    for row in c.iter().take(3) {
        volume += row[0] + row[1] + row[2];
    }
    let trace = c[0][0] + c[1][1] + c[2][2] + 2.0 * (c[3][3] + c[4][4] + c[5][5]);
    let mu = (3.0 * trace - volume) / 30.0;
    Lame { lambda_: volume / 9.0 - 2.0 / 3.0 * mu, mu }
}

impl Stiffness {
    /// C : e.
    fn apply(&self, e: &Matrix3<f64>) -> Matrix3<f64> {
        match self {
            Self::Isotropic(l) => e * (2.0 * l.mu) + Matrix3::identity() * (l.lambda_ * e.trace()),
            Self::General(c) => {
                let strain = PAIRS.map(|(i, j)| if i == j { e[(i, i)] } else { 2.0 * e[(i, j)] });
                let mut out = Matrix3::zeros();
                for (row, &(i, j)) in PAIRS.iter().enumerate() {
                    let mut stress = 0.0;
                    for (col, s) in strain.iter().enumerate() {
                        stress += 0.5 * (c[row][col] + c[col][row]) * s;
                    }
                    out[(i, j)] = stress;
                    out[(j, i)] = stress;
                }
                out
            }
        }
    }

    /// C in the axes given by the columns of `v`, by the stress transformation of Bond (1943).
    fn in_frame(&self, v: &Matrix3<f64>) -> Voigt {
        match self {
            Self::Isotropic(l) => std::array::from_fn(|i| {
                std::array::from_fn(|j| match (i, j) {
                    (0..3, 0..3) if i == j => l.lambda_ + 2.0 * l.mu,
                    (0..3, 0..3) => l.lambda_,
                    _ if i == j => l.mu,
                    _ => 0.0,
                })
            }),
            Self::General(c) => {
                // σ'_ij = Σ v_ki v_lj σ_kl: each shear stress in Voigt order occurs twice in the sum.
                let bond = Matrix6::from_fn(|row, col| {
                    let ((i, j), (k, l)) = (PAIRS[row], PAIRS[col]);
                    let one = v[(k, i)] * v[(l, j)];
                    if k == l { one } else { one + v[(l, i)] * v[(k, j)] }
                });
                let turned = bond * voigt_matrix(c) * bond.transpose();
                std::array::from_fn(|i| std::array::from_fn(|j| turned[(i, j)]))
            }
        }
    }
}

/// e = U − I in global axes.
fn stretch_strain(polar: &Polar) -> Matrix3<f64> {
    let e = polar.v * Matrix3::from_diagonal(&polar.stretch.add_scalar(-1.0)) * polar.v.transpose();
    0.5 * (e + e.transpose())
}

/// Qᵀ P V of the stretch energy with T = C : e: 2 u_i T_ij / (u_i + u_j) in the principal frame at rest.
///
/// From δW = T : δU and δU U + U δU = δ(FᵀF); symmetric T U, as with isotropic C, gives P = R T.
fn in_frame_stress(polar: &Polar, t: &Matrix3<f64>) -> Matrix3<f64> {
    let t = polar.v.transpose() * t * polar.v;
    let u = polar.stretch;
    Matrix3::from_fn(|i, j| {
        if i == j { t[(i, i)] } else { 2.0 * u[i] * t[(i, j)] / stretch_sum(u[i], u[j]) }
    })
}

fn stretch_sum(a: f64, b: f64) -> f64 {
    (a + b).max(LEAST_STRETCH_SUM)
}

/// ∂²W/∂F² of the stretch energy; `pressure` is added to T in the terms from the second derivative of U.
///
/// With A = Qᵀ δF V, E_ij = (u_i A_ij + u_j A_ji)/(u_i + u_j) is δU and Ω_ij = (A_ij − A_ji)/(u_i + u_j) the
/// rotation, A_ij = Ω_ij u_j + E_ij, in the principal frame at rest. Then δ²W = E : C : E + T : δ²U, and
/// differentiating U² = FᵀF twice gives δ²U_ij = 2 Σ_k (A_ki A_kj − E_ki E_kj)/(u_i + u_j).
fn stretch_tangent(stiffness: &Stiffness, f: &Matrix3<f64>, pressure: f64) -> Tangent {
    let polar = Polar::new(f);
    let (u, v) = (polar.stretch, polar.v);
    let t = v.transpose() * stiffness.apply(&stretch_strain(&polar)) * v
        + Matrix3::identity() * pressure;
    let sum = Matrix3::from_fn(|i, j| stretch_sum(u[i], u[j]));

    // E : C : E. Entry (r, c) of A contributes to a single component of E, given by `strains` in Voigt order.
    let strains: [f64; 9] = std::array::from_fn(|rc| {
        let (r, c) = (rc / 3, rc % 3);
        if r == c { 1.0 } else { 2.0 * u[r] / sum[(r, c)] }
    });
    let c = stiffness.in_frame(&v);
    let mut in_frame = Tangent::zeros();
    for a in 0..9 {
        for b in 0..9 {
            in_frame[(a, b)] = strains[a] * c[VOIGT[a]][VOIGT[b]] * strains[b];
        }
    }
    // T : δ²U on the diagonal: A² − E² = u_i Ω (A + E), whose factor u_i cancels with that of T_ii / u_i.
    for i in 0..3 {
        for k in (0..3).filter(|&k| k != i) {
            let (here, there) = (3 * k + i, 3 * i + k);
            let turn = t[(i, i)] / sum[(k, i)];
            // A_ki + E_ki in terms of A_ki and A_ik.
            let (own, other) = (1.0 + u[k] / sum[(k, i)], u[i] / sum[(k, i)]);
            in_frame[(here, here)] += turn * own;
            in_frame[(there, there)] -= turn * other;
            in_frame[(here, there)] += 0.5 * turn * (other - own);
            in_frame[(there, here)] += 0.5 * turn * (other - own);
        }
    }
    // Off the diagonal: 2 T_ij/(u_i + u_j) on both sides of it.
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        let weight = 2.0 * t[(i, j)] / sum[(i, j)];
        if weight == 0.0 {
            continue;
        }
        for k in 0..3 {
            let (ki, kj) = (3 * k + i, 3 * k + j);
            in_frame[(ki, kj)] += weight;
            in_frame[(kj, ki)] += weight;
            for (a, share_a) in strained_by(k, i, &u, &sum) {
                for (b, share_b) in strained_by(k, j, &u, &sum) {
                    in_frame[(a, b)] -= weight * share_a * share_b;
                    in_frame[(b, a)] -= weight * share_a * share_b;
                }
            }
        }
    }
    carried(&in_frame, &polar.q, &v)
}

/// The entries of A that contribute to E_ij, at 3r + c, with their weights.
fn strained_by(i: usize, j: usize, u: &Vector3<f64>, sum: &Matrix3<f64>) -> [(usize, f64); 2] {
    if i == j {
        return [(4 * i, 0.5), (4 * i, 0.5)];
    }
    [(3 * i + j, u[i] / sum[(i, j)]), (3 * j + i, u[j] / sum[(i, j)])]
}

/// Derivatives with respect to F from those with respect to A = Qᵀ F V, one index after another.
fn carried(in_frame: &Tangent, q: &Matrix3<f64>, v: &Matrix3<f64>) -> Tangent {
    // Columns (t, u) to (k, l) by Q and V, twice: the form is symmetric, so its transpose is transformed in the
    // same way.
    let turned = |h: &Tangent| {
        let mut half = Tangent::zeros();
        for t in 0..3 {
            for l in 0..3 {
                let mut column = h.column(3 * t) * v[(l, 0)];
                column += h.column(3 * t + 1) * v[(l, 1)];
                column += h.column(3 * t + 2) * v[(l, 2)];
                half.set_column(3 * t + l, &column);
            }
        }
        let mut out = Tangent::zeros();
        for k in 0..3 {
            for l in 0..3 {
                let mut column = half.column(l) * q[(k, 0)];
                column += half.column(3 + l) * q[(k, 1)];
                column += half.column(6 + l) * q[(k, 2)];
                out.set_column(3 * k + l, &column);
            }
        }
        out
    };
    turned(&turned(in_frame).transpose())
}

/// Adds `stress` ∂²J/∂F²: δ²J = F : (δF × δF), the cross product of tensors.
fn add_cofactor_tangent(out: &mut Tangent, f: &Matrix3<f64>, stress: f64) {
    // ∂²J/∂F_ij∂F_kl = ε_ikm ε_jln F_mn.
    for i in 0..3 {
        for j in 0..3 {
            for (k, m, row_sign) in
                [((i + 1) % 3, (i + 2) % 3, 1.0), ((i + 2) % 3, (i + 1) % 3, -1.0)]
            {
                for (l, n, column_sign) in
                    [((j + 1) % 3, (j + 2) % 3, 1.0), ((j + 2) % 3, (j + 1) % 3, -1.0)]
                {
                    out[(3 * i + j, 3 * k + l)] += stress * row_sign * column_sign * f[(m, n)];
                }
            }
        }
    }
}

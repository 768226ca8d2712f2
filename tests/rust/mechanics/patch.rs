//! Statements about the tensors that hold exactly: patch test, rigid motions, symmetry, zero modes.

use std::sync::Arc;

use crate::meshes::{
    BoxShape, Numbers, Vec3, affine, any_stiffness, at, boundary, joined, largest,
    largest_difference, plan, solve, tensors, tissues, with_method,
};
use mtm_core::{
    Elastic, FibreElastic, FibreLaw, Lame, MassTensors, Method, Motion, Spencer, TetMaterial,
    TetMesh, Tissue, Voigt, tet_tensor,
};
use nalgebra::{DMatrix, Matrix3, Matrix6, SMatrix, SymmetricEigen};

/// H of the affine fields: every strain and rotation component differs from zero.
fn gradient() -> Matrix3<f64> {
    Matrix3::new(0.03, -0.01, 0.02, 0.015, -0.02, 0.005, -0.007, 0.012, 0.01)
}

/// Mesh whose tets carry materials of all three kinds, from soft to 1000 times stiffer.
fn mixed(mesh: &Arc<TetMesh>) -> Arc<Tissue> {
    let mut numbers = Numbers(21);
    let rows: Vec<Voigt> = (0..mesh.n_tets())
        .map(|t| match t % 3 {
            0 => {
                let young = 10_f64.powf(1.5 * numbers.next());
                let lame = Lame::from(Elastic { young, poisson: 0.4 });
                TetMaterial::Isotropic(lame).voigt()
            }
            1 => {
                let moduli = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
                let c = Spencer::from_moduli(moduli, FibreLaw::Spencer);
                TetMaterial::Spencer(c, numbers.unit()).voigt()
            }
            _ => any_stiffness(t as u64),
        })
        .collect();
    Arc::new(Tissue::from_stiffness(rows).unwrap())
}

/// Patch test (Irons 1966): with u = H x + t prescribed on the hull of a uniform body, the inner nodes
/// follow the same field, the stress is C ε everywhere, and the hull carries σ n A.
#[test]
fn affine_boundary_motion_gives_the_affine_field_inside() {
    let shape = BoxShape::cube(5);
    let mesh = shape.mesh();
    let hull = shape.hull();
    let exact = affine(mesh.nodes(), gradient(), Vec3::new(0.3, -0.2, 0.1));
    let bounds = boundary(vec![], vec![joined("hull", hull.clone())]);
    for (name, tissue) in tissues() {
        let tensors = tensors(&mesh, &tissue);
        let motion = plan([("hull", Motion::Nodes(at(&exact, &hull)))]);
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap();
        let error = largest_difference(&found.displacements, &exact);
        assert!(error <= 1e-13, "{name}: {error:e} mm");

        let c = tissue.stiffness()[0];
        let h = gradient();
        let strain = [
            h[(0, 0)],
            h[(1, 1)],
            h[(2, 2)],
            h[(1, 2)] + h[(2, 1)],
            h[(0, 2)] + h[(2, 0)],
            h[(0, 1)] + h[(1, 0)],
        ];
        let stress: Vec<f64> = (0..6).map(|i| (0..6).map(|j| c[i][j] * strain[j]).sum()).collect();
        let largest_stress = stress.iter().fold(0.0_f64, |m, s| m.max(s.abs()));
        for row in tensors.stress(&found.displacements).unwrap() {
            for i in 0..6 {
                assert!((row[i] - stress[i]).abs() <= 1e-11 * largest_stress, "{name}: {row:?}");
            }
        }
        // The cut x = 2.5 mm carries A σ e_x: the sum of the forces on one side of it.
        let mut force = Vec3::zeros();
        for (x, f) in mesh.nodes().iter().zip(&found.forces) {
            if x[0] > 2.5 {
                force += Vec3::from(*f);
            }
        }
        let expected = 25.0 * Vec3::new(stress[0], stress[5], stress[4]);
        assert!((force - expected).norm() <= 1e-11 * expected.norm(), "{name}: {force:?}");
    }
}

/// ½ uᵀ K u = ½ V ε·C ε under an affine field, and K u·u is that same energy twice.
#[test]
fn energy_of_an_affine_field_is_that_of_its_strain() {
    let shape = BoxShape::cube(4);
    let mesh = shape.mesh();
    let u = affine(mesh.nodes(), gradient(), Vec3::zeros());
    for (name, tissue) in tissues() {
        let tensors = tensors(&mesh, &tissue);
        let (strain, stress) = (tensors.strain(&u).unwrap(), tensors.stress(&u).unwrap());
        let density: f64 = (0..6).map(|i| 0.5 * strain[0][i] * stress[0][i]).sum();
        let energy = tensors.energy(&u).unwrap();
        assert!((energy - 64.0 * density).abs() <= 1e-12 * energy, "{name}");
        let forces = tensors.internal_force(&u).unwrap();
        let work: f64 =
            forces.iter().zip(&u).map(|(f, u)| Vec3::from(*f).dot(&Vec3::from(*u))).sum();
        assert!((work - 2.0 * energy).abs() <= 1e-11 * work, "{name}");
    }
}

/// Forces of `u`, over those of a field as large that deforms every tet.
fn relative_force(tensors: &MassTensors, u: &[[f64; 3]]) -> f64 {
    let size = largest(u);
    let rough: Vec<[f64; 3]> =
        Numbers(5).points(u.len()).iter().map(|v| v.map(|x| x * size)).collect();
    largest(&tensors.internal_force(u).unwrap()) / largest(&tensors.internal_force(&rough).unwrap())
}

/// K t = 0 for u = t: a translation stores no energy (Cotin et al. 2000).
#[test]
fn rigid_translation_gives_no_force() {
    let mesh = BoxShape::cube(5).mesh();
    let tensors = tensors(&mesh, &mixed(&mesh));
    let u = vec![[3.0, -2.0, 5.0]; mesh.n_nodes()];
    let force = relative_force(&tensors, &u);
    assert!(force <= 1e-14, "{force:e}");
}

/// K (w × x) = 0: the linear strain of an infinitesimal rotation vanishes.
#[test]
fn infinitesimal_rotation_gives_no_force() {
    let mesh = BoxShape::cube(5).mesh();
    let tensors = tensors(&mesh, &mixed(&mesh));
    let w = Vec3::new(0.4, -1.1, 0.7);
    let u: Vec<[f64; 3]> = mesh.nodes().iter().map(|&x| w.cross(&Vec3::from(x)).into()).collect();
    let force = relative_force(&tensors, &u);
    assert!(force <= 1e-13, "{force:e}");
}

/// K_jj = −Σ_k K_jk: rows sum to zero, because shape gradients do.
#[test]
fn vertex_tensor_is_minus_the_sum_of_its_edge_tensors() {
    let mesh = BoxShape::cube(5).mesh();
    let tensors = tensors(&mesh, &mixed(&mesh));
    for j in 0..mesh.n_nodes() {
        let (_, blocks) = tensors.matrix().row(j);
        let mut sum = [0.0; 9];
        let mut size = 0.0_f64;
        for block in blocks {
            for i in 0..9 {
                sum[i] += block[i];
                size = size.max(block[i].abs());
            }
        }
        for s in sum {
            assert!(s.abs() <= 1e-13 * size, "node {j}: {s:e} of {size:e}");
        }
    }
}

/// K_kj = K_jkᵀ bit for bit, and the list of edges holds exactly these tensors.
#[test]
fn opposite_edge_tensors_are_transposes_to_the_last_bit() {
    let mesh = BoxShape::cube(5).mesh();
    let tensors = tensors(&mesh, &mixed(&mesh));
    let matrix = tensors.matrix();
    let edges = tensors.edge_tensors();
    let mut n_edges = 0;
    for j in 0..matrix.n_rows() {
        let (columns, blocks) = matrix.row(j);
        for (&k, block) in columns.iter().zip(blocks) {
            let (back, other) = matrix.row(k as usize);
            let mirror = other[back.binary_search(&(j as u32)).unwrap()];
            let size = block.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            for i in 0..9 {
                let opposite = mirror[3 * (i % 3) + i / 3];
                if j as u32 == k {
                    // A vertex tensor sums its products in another order above and below its diagonal.
                    assert!((block[i] - opposite).abs() <= 1e-13 * size, "node {j}");
                } else {
                    assert_eq!(block[i].to_bits(), opposite.to_bits(), "edge {j}, {k}");
                }
            }
            if (j as u32) < k {
                assert_eq!(edges.edges[n_edges], [j as u32, k]);
                assert_eq!(edges.tensors[n_edges], *block);
                n_edges += 1;
            }
        }
    }
    assert_eq!(n_edges, edges.edges.len());
    assert_eq!(tensors.vertex_tensors()[7], *matrix.diagonal_block(7));
}

/// K_jk = V B_jᵀ C B_k (Zienkiewicz & Taylor) with B written out here and C by `Tissue::stiffness`,
/// for the tensor formulas of Spencer's law and of the isotropic one.
#[test]
fn tensor_formulas_equal_the_strain_matrix_product() {
    let mesh = BoxShape::cube(2).mesh();
    let mut numbers = Numbers(9);
    for t in 0..mesh.n_tets() {
        let geometry = mesh.geometry(t);
        let b: Vec<SMatrix<f64, 6, 3>> = geometry
            .gradients
            .iter()
            .map(|g| {
                SMatrix::<f64, 6, 3>::from_row_slice(&[
                    g[0], 0.0, 0.0, 0.0, g[1], 0.0, 0.0, 0.0, g[2], 0.0, g[2], g[1], g[2], 0.0,
                    g[0], g[1], g[0], 0.0,
                ])
            })
            .collect();
        let poisson = 0.2 + 0.29 * numbers.next();
        let moduli = FibreElastic {
            young_along: 10_f64.powf(2.0 * numbers.next()),
            young_across: 1.0,
            poisson,
        };
        let spencer = Spencer::from_moduli(moduli, FibreLaw::Spencer);
        let picinbono = Spencer::from_moduli(moduli, FibreLaw::Picinbono);
        let lame = Lame::from(Elastic { young: moduli.young_along, poisson });
        let fibre = numbers.unit();
        for material in [
            TetMaterial::Spencer(spencer, fibre),
            TetMaterial::Spencer(picinbono, fibre),
            TetMaterial::Isotropic(lame),
            TetMaterial::General(&any_stiffness(t as u64)),
        ] {
            let voigt = material.voigt();
            let c = Matrix6::from_fn(|i, j| voigt[i][j]);
            for j in 0..4 {
                for k in 0..4 {
                    let expected = b[j].transpose() * c * b[k] * geometry.volume;
                    let found = tet_tensor(&geometry, &material, j, k);
                    let scale = geometry.volume * c.amax() * b[j].amax() * b[k].amax();
                    for i in 0..9 {
                        let e = (found[i] - expected[(i / 3, i % 3)]).abs();
                        assert!(e <= 1e-14 * scale, "{material:?} ({j}, {k}): {e:e} of {scale:e}");
                    }
                }
            }
        }
    }
}

/// Spencer's C inverts to the engineering compliance: S11 = 1/E_l, S22 = S33 = 1/E_t,
/// S12 = −ν_lt/E_l, S23 = −ν/E_t, S44 = 2(1+ν)/E_t, S55 = S66 = 1/E_l + 1/E_t + 2ν_lt/E_l
/// (Saint-Venant), ν_lt = ν if E_l ≥ E_t, else ν E_l/E_t; fibre along x.
#[test]
fn spencer_stiffness_is_the_inverse_of_the_engineering_compliance() {
    for (el, et, nu) in
        [(0.5, 0.79, 0.43), (0.79, 0.5, 0.43), (1e3, 1.0, 0.3), (1.0, 1e3, 0.49), (1.0, 1.0, 0.25)]
    {
        let nu_lt = if el >= et { nu } else { nu * el / et };
        let mut s = Matrix6::zeros();
        s[(0, 0)] = 1.0 / el;
        (s[(1, 1)], s[(2, 2)]) = (1.0 / et, 1.0 / et);
        for (i, j, v) in [(0, 1, nu_lt / el), (0, 2, nu_lt / el), (1, 2, nu / et)] {
            (s[(i, j)], s[(j, i)]) = (-v, -v);
        }
        s[(3, 3)] = 2.0 * (1.0 + nu) / et;
        let shear = 1.0 / el + 1.0 / et + 2.0 * nu_lt / el;
        (s[(4, 4)], s[(5, 5)]) = (shear, shear);
        let expected = s.try_inverse().unwrap();
        let moduli = FibreElastic { young_along: el, young_across: et, poisson: nu };
        let c = Spencer::from_moduli(moduli, FibreLaw::Spencer).voigt([1.0, 0.0, 0.0]);
        for i in 0..6 {
            for j in 0..6 {
                let e = (c[i][j] - expected[(i, j)]).abs();
                assert!(e <= 1e-12 * expected.amax(), "{el} {et} {nu} [{i}][{j}]: {e:e}");
            }
        }
    }
}

/// K of a connected body has rank 3n − 6: six zero eigenvalues, the rigid modes, all others positive.
#[test]
fn stiffness_has_exactly_six_zero_modes() {
    let mesh = BoxShape::cube(3).mesh();
    for tissue in tissues().into_iter().map(|(_, tissue)| tissue).chain([mixed(&mesh)]) {
        let tensors = tensors(&mesh, &tissue);
        let n = 3 * mesh.n_nodes();
        let mut k = DMatrix::<f64>::zeros(n, n);
        for j in 0..mesh.n_nodes() {
            let (columns, blocks) = tensors.matrix().row(j);
            for (&c, block) in columns.iter().zip(blocks) {
                for i in 0..9 {
                    k[(3 * j + i / 3, 3 * c as usize + i % 3)] = block[i];
                }
            }
        }
        let mut values: Vec<f64> = SymmetricEigen::new(k).eigenvalues.iter().copied().collect();
        values.sort_by(f64::total_cmp);
        let top = values[n - 1];
        for v in &values[..6] {
            assert!(v.abs() <= 1e-13 * top, "zero mode {v:e} of {top:e}");
        }
        assert!(values[6] >= 1e-7 * top, "seventh eigenvalue {:e} of {top:e}", values[6]);
    }
}

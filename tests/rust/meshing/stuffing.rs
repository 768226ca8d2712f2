//! Isosurface stuffing: shapes, volume, boundary, thin parts, determinism, bad input.

use mtm_core::{
    Grid, Halvings, LevelImage, MtmError, Parted, Stuffed, StuffingOptions, Surface, TetMesh, part,
    signed_distance, stuff,
};
use proptest::prelude::*;

fn image(n: usize, spacing: f64, level: impl Fn([f64; 3]) -> f64) -> LevelImage {
    let grid = Grid::new([n; 3], [spacing; 3], [0.0; 3]).expect("a grid");
    let values = (0..grid.len()).map(|i| level(grid.centre(i)).clamp(-3.0, 3.0) as f32).collect();
    LevelImage::new(grid, values).expect("a level")
}

fn radius(x: [f64; 3], centre: [f64; 3]) -> f64 {
    (0..3).map(|a| (x[a] - centre[a]).powi(2)).sum::<f64>().sqrt()
}

fn options(edge_length: f64, refinements: u32) -> StuffingOptions {
    StuffingOptions { edge_length, refinements, least_body: 0.0 }
}

fn least_dihedral(mesh: &TetMesh) -> f64 {
    mesh.quality().min_dihedral.iter().copied().fold(f64::INFINITY, f64::min).to_degrees()
}

fn volume(mesh: &TetMesh) -> f64 {
    mesh.volumes().iter().sum()
}

/// Every face belongs to one or two tets, and every boundary edge to an even number of boundary faces.
fn assert_conforming(mesh: &TetMesh) {
    let mut faces = std::collections::HashMap::new();
    for tet in mesh.tets() {
        for face in [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]] {
            let mut face = face.map(|v| tet[v]);
            face.sort_unstable();
            *faces.entry(face).or_insert(0) += 1;
        }
    }
    assert!(faces.values().all(|&n| n <= 2), "a face belongs to three tets");
    let mut edges = std::collections::HashMap::new();
    for [a, b, c] in mesh.boundary_triangles() {
        for (p, q) in [(a, b), (b, c), (c, a)] {
            *edges.entry((p.min(q), p.max(q))).or_insert(0) += if p < q { 1 } else { -1 };
        }
    }
    assert!(edges.values().all(|&n| n == 0), "the boundary is not closed");
}

const CENTRE: [f64; 3] = [24.3, 25.1, 24.8];

fn ball(made_of: f64) -> LevelImage {
    image(50, 1.0, |x| made_of - radius(x, CENTRE))
}

#[test]
fn a_ball_has_its_volume_and_its_surface() {
    // A sphere of radius r is met to h²/8r by chords of length h.
    let level = ball(20.0);
    let Stuffed { mesh, boundary_error_mean, boundary_error_max, level_volume, .. } =
        stuff(&level, &options(3.0, 1), &Halvings::default()).expect("a mesh");
    let exact = 4.0 / 3.0 * std::f64::consts::PI * 20.0_f64.powi(3);
    assert!((volume(&mesh) / exact - 1.0).abs() < 0.01, "volume {}", volume(&mesh));
    assert!((level_volume / exact - 1.0).abs() < 0.002, "level volume {level_volume}");
    assert!(boundary_error_mean < 3.0 / 8.0 / 20.0 * 3.0, "mean {boundary_error_mean}");
    assert!(boundary_error_max < 0.3, "largest {boundary_error_max}");
    assert!(least_dihedral(&mesh) >= 10.0);
    assert_conforming(&mesh);
}

#[test]
fn the_volume_error_falls_with_the_square_of_the_edge() {
    let level = ball(20.0);
    let error = |edge: f64| {
        let mesh = stuff(&level, &options(edge, 0), &Halvings::default()).expect("a mesh").mesh;
        (volume(&mesh) / (4.0 / 3.0 * std::f64::consts::PI * 8000.0) - 1.0).abs()
    };
    let (coarse, fine) = (error(6.0), error(3.0));
    let order = (coarse / fine).log2();
    assert!((1.5..2.6).contains(&order), "order {order} from {coarse} to {fine}");
}

#[test]
fn a_lattice_of_one_size_keeps_the_bound_of_the_paper_on_noise() {
    // Labelle & Shewchuk (2007), theorem 1: 10.78°; the level is as bad as a level can be.
    let level = image(40, 1.0, |x| {
        let s: f64 = (x[0] * 12.9898 + x[1] * 78.233 + x[2] * 37.719).sin() * 43758.5453;
        s - s.floor() - 0.5
    });
    for refinements in 0..2 {
        let mesh =
            stuff(&level, &options(3.0, refinements), &Halvings::default()).expect("a mesh").mesh;
        assert!(least_dihedral(&mesh) >= 10.7, "{}", least_dihedral(&mesh));
        assert_conforming(&mesh);
    }
}

#[test]
fn a_sheet_thinner_than_the_edge_is_kept_by_refinement_and_lost_without() {
    let sheet = image(50, 1.0, |x| 1.0 - (radius(x, CENTRE) - 18.0).abs());
    let exact = 4.0 / 3.0 * std::f64::consts::PI * (19.0_f64.powi(3) - 17.0_f64.powi(3));
    let share = |r| {
        volume(&stuff(&sheet, &options(3.0, r), &Halvings::default()).expect("a mesh").mesh) / exact
    };
    assert!(share(0) < 0.5);
    assert!((share(1) - 1.0).abs() < 0.02, "{}", share(1));
}

#[test]
fn a_gap_thinner_than_the_edge_parts_two_bodies() {
    // Two half balls, one voxel apart: the lips of a face.
    let lips = image(50, 1.0, |x| (18.0 - radius(x, CENTRE)).min((x[2] - CENTRE[2]).abs() - 0.7));
    let made = stuff(&lips, &options(3.0, 2), &Halvings::default()).expect("a mesh");
    let upper = made.mesh.nodes().iter().map(|x| x[2] > CENTRE[2]).collect::<Vec<_>>();
    let bridging =
        made.mesh.tets().iter().filter(|t| {
            t.iter().any(|&v| upper[v as usize]) && t.iter().any(|&v| !upper[v as usize])
        });
    assert_eq!(bridging.count(), 0);
    assert!(least_dihedral(&made.mesh) >= 10.0);
    assert_conforming(&made.mesh);
}

fn at_most(allowed: &[u8]) -> Halvings<'_> {
    Halvings { allowed: Some(allowed), needed: None }
}

#[test]
fn only_what_is_allowed_is_refined() {
    let sheets = image(60, 1.0, |x| {
        let sheet = |z: f64| (1.0 - (x[2] - z).abs()).min(24.0 - radius(x, [30.0, 30.0, z]));
        sheet(15.2).max(sheet(44.7))
    });
    let allowed: Vec<u8> = (0..216_000).map(|i| u8::from(i % 60 < 30)).collect();
    let mesh = stuff(&sheets, &options(3.0, 1), &at_most(&allowed)).expect("a mesh").mesh;
    let volume_of = |low: bool| -> f64 {
        let at = |t: &[u32; 4]| (mesh.nodes()[t[0] as usize][2] < 30.0) == low;
        mesh.tets().iter().zip(mesh.volumes()).filter(|(t, _)| at(t)).map(|(_, v)| v).sum()
    };
    let exact = std::f64::consts::PI * 24.0_f64.powi(2) * 2.0;
    assert!(volume_of(true) > 0.95 * exact, "{}", volume_of(true));
    assert!(volume_of(false) < 0.6 * exact, "{}", volume_of(false));
    let short = stuff(&sheets, &options(3.0, 1), &at_most(&allowed[1..]));
    assert!(matches!(short, Err(MtmError::Length { .. })));
}

#[test]
fn what_needs_it_is_refined_where_nothing_is_thin() {
    let level = ball(20.0);
    let needed: Vec<u8> = (0..125_000).map(|i| if i % 50 >= 30 { 2 } else { 0 }).collect();
    let at_least = |needed: &[u8], refinements| {
        let halvings = Halvings { allowed: None, needed: Some(needed) };
        stuff(&level, &options(4.0, refinements), &halvings)
    };
    let mesh = at_least(&needed, 2).expect("a mesh").mesh;
    let one_size = stuff(&level, &options(4.0, 0), &Halvings::default()).expect("a mesh").mesh;
    let mean_volume = |mesh: &TetMesh, low: f64, high: f64| {
        let at =
            |t: &[u32; 4]| t.iter().all(|&v| (low..high).contains(&mesh.nodes()[v as usize][2]));
        let inside = mesh.tets().iter().zip(mesh.volumes()).filter(|(t, _)| at(t));
        let (sum, count) = inside.fold((0.0, 0), |(sum, n), (_, volume)| (sum + volume, n + 1));
        sum / f64::from(count)
    };
    let upper = mean_volume(&one_size, 31.0, 50.0) / mean_volume(&mesh, 31.0, 50.0);
    let lower = mean_volume(&one_size, 0.0, 20.0) / mean_volume(&mesh, 0.0, 20.0);
    assert!((55.0..75.0).contains(&upper), "a quarter of the edge, 1/{upper} of the volume");
    assert!((0.99..1.01).contains(&lower), "untouched, 1/{lower} of the volume");
    assert!(least_dihedral(&mesh) >= 10.0, "{}", least_dihedral(&mesh));
    assert_conforming(&mesh);

    let short = at_least(&needed[1..], 2);
    assert!(matches!(short, Err(MtmError::Length { .. })));
    let first = needed.iter().position(|&n| n > 1).expect("one that needs two");
    let two_of_one = at_least(&needed, 1).expect_err("two are needed, one is allowed");
    assert!(matches!(
        two_of_one,
        MtmError::OutOfRange { index, value: 2.0, .. } if index == first
    ));
}

#[test]
fn labels_keep_flat_faces_half_way_between_voxels() {
    let grid = Grid::new([14, 15, 16], [1.0, 2.0, 0.5], [5.0, 6.0, 7.0]).expect("a grid");
    let inside: Vec<bool> = (0..grid.len())
        .map(|i| [i / 240, i / 16 % 15, i % 16])
        .map(|[i, j, k]| (2..12).contains(&i) && (3..13).contains(&j) && (2..14).contains(&k))
        .collect();
    let level = LevelImage::from_labels(grid, &inside).expect("a level");
    for (voxel, expected) in
        [([6.5, 14.0, 10.0], 0.0), ([10.0, 11.0, 10.0], 0.0), ([10.0, 14.0, 7.75], 0.0)]
    {
        assert!((level.value(voxel) - expected).abs() < 1e-6, "{voxel:?}: {}", level.value(voxel));
    }
    assert!((level.volume() / (10.0 * 20.0 * 6.0) - 1.0).abs() < 0.06, "{}", level.volume());
}

#[test]
fn every_voxel_of_a_label_image_keeps_its_side() {
    let grid = Grid::new([9, 9, 9], [1.0; 3], [0.0; 3]).expect("a grid");
    let inside: Vec<bool> = (0..729).map(|i| i % 7 == 0 || (300..420).contains(&i)).collect();
    let level = LevelImage::from_labels(grid, &inside).expect("a level");
    for (i, &inside) in inside.iter().enumerate() {
        assert_eq!(level.value(grid.centre(i)) > 0.0, inside, "voxel {i}");
    }
}

#[test]
fn tissue_ends_where_its_image_ends() {
    let grid = Grid::new([10, 10, 10], [1.0; 3], [0.0; 3]).expect("a grid");
    let level = LevelImage::from_labels(grid, &[true; 1000]).expect("a level");
    let mesh = stuff(&level, &options(2.0, 0), &Halvings::default()).expect("a mesh").mesh;
    assert!((volume(&mesh) / 1000.0 - 1.0).abs() < 0.05, "{}", volume(&mesh));
    assert_conforming(&mesh);
}

#[test]
fn specks_go_and_bodies_stay() {
    let level = image(60, 1.0, |x| {
        let balls =
            [([20.0, 20.0, 20.0], 12.0), ([45.0, 45.0, 45.0], 8.0), ([45.0, 15.0, 45.0], 3.0)];
        balls.iter().map(|&(c, r)| r - radius(x, c)).fold(f64::NEG_INFINITY, f64::max)
    });
    let all = stuff(&level, &options(3.0, 0), &Halvings::default()).expect("a mesh");
    assert_eq!(all.dropped.parts, 0);
    let kept = stuff(
        &level,
        &StuffingOptions { least_body: 500.0, ..options(3.0, 0) },
        &Halvings::default(),
    );
    let kept = kept.expect("a mesh");
    assert_eq!(kept.dropped.parts, 1);
    assert!((volume(&all.mesh) - volume(&kept.mesh) - kept.dropped.volume).abs() < 1e-9);
}

#[test]
fn the_mesh_has_the_same_bits_for_any_number_of_threads() {
    let level = image(40, 1.0, |x| {
        (14.0 - radius(x, [20.0; 3])).min(1.2 + (x[0] * 0.9).sin() + 0.1 * (x[1] - 20.0).abs())
    });
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| stuff(&level, &options(3.0, 2), &Halvings::default()).expect("a mesh").mesh)
    };
    let (one, three) = (run(1), run(3));
    assert_eq!(one.nodes(), three.nodes());
    assert_eq!(one.tets(), three.tets());
}

#[test]
fn the_signed_distance_of_a_surface_is_that_of_brute_force() {
    let surface = {
        let mesh = stuff(&ball(15.0), &options(4.0, 0), &Halvings::default()).expect("a mesh").mesh;
        Surface::new(mesh.nodes().to_vec(), mesh.boundary_triangles().to_vec()).expect("a surface")
    };
    let grid = Grid::new([25, 24, 26], [2.0, 2.1, 1.9], [0.0; 3]).expect("a grid");
    let level = signed_distance(&surface, grid, 4.0).expect("a level");
    for i in (0..grid.len()).step_by(7) {
        let x = grid.centre(i);
        let c = surface.closest_one(x).point;
        let inside = mtm_core::winding_number_exact(&surface, &[x])[0] > 0.5;
        let d = radius(x, c).min(4.0) * if inside { 1.0 } else { -1.0 };
        assert!((f64::from(level.values()[i]) - d).abs() < 1e-5, "voxel {i}");
    }
    assert!((level.volume() / surface.volume().expect("closed") - 1.0).abs() < 0.02);
}

#[test]
fn a_parting_surface_parts_the_mesh_and_leaves_its_rim_joined() {
    let mesh = block();
    for z in [7.7, 8.8, 9.3, 9.9, 10.1] {
        let sheet = |to: f64| {
            let corners = vec![[-5.0, -5.0, z], [to, -5.0, z], [to, 25.0, z], [-5.0, 25.0, z]];
            Surface::new(corners, vec![[0, 1, 2], [0, 2, 3]]).expect("a sheet")
        };
        for (to, bodies) in [(10.0, 1), (25.0, 2)] {
            let split = part(&mesh, &sheet(to)).expect("parted");
            assert!(split.parents.len() > 10);
            assert_eq!(split.mesh.n_nodes(), mesh.n_nodes() + split.parents.len());
            assert!((volume(&split.mesh) / volume(&mesh) - 1.0).abs() < 1e-4);
            assert!(least_dihedral(&split.mesh) >= 15.0, "at {z}: {}", least_dihedral(&split.mesh));
            assert_conforming(&split.mesh);
            assert_eq!(n_bodies(&split.mesh), bodies);
            assert_new_nodes_lie_between_their_parents(&mesh, &split);
            // The crack is as flat as the sheet.
            let new = &split.mesh.nodes()[mesh.n_nodes()..];
            assert!(new.iter().all(|x| (x[2] - z).abs() < 1e-12));
            let on_sheet = |t: &&[u32; 3]| {
                t.iter().all(|&j| (split.mesh.nodes()[j as usize][2] - z).abs() < 1e-12)
            };
            let boundary = split.mesh.boundary_triangles();
            assert!(boundary.iter().filter(on_sheet).count() > 50);
        }
    }
    let far =
        Surface::new(vec![[0.0, 0.0, 90.0], [9.0, 0.0, 90.0], [0.0, 9.0, 90.0]], vec![[0, 1, 2]]);
    assert!(matches!(part(&mesh, &far.expect("a sheet")), Err(MtmError::OutOfRange { .. })));
}

/// A node on an edge lies between its parents, but for the distance by which they moved; a copy where its
/// original does.
fn assert_new_nodes_lie_between_their_parents(mesh: &TetMesh, split: &Parted) {
    let places = split.mesh.nodes();
    for (k, &[a, b]) in split.parents.iter().enumerate() {
        let x = places[mesh.n_nodes() + k];
        let [p, q] = [a, b].map(|j| places[j as usize]);
        if a == b {
            assert_eq!(x, p);
        } else {
            let detour = radius(x, p) + radius(x, q) - radius(p, q);
            assert!(detour < 1e-12, "node {k}: {detour}");
        }
    }
}

#[test]
fn a_bent_parting_surface_leaves_no_bridge_along_its_bends() {
    let mesh = block();
    // A roof and its mirror image, a gutter: slopes of 30° on either side of the bend.
    for (edge, bend) in [(5.0, 13.7), (14.0, 5.3)] {
        let row = |x: f64, z: f64| [[x, -5.0, z], [x, 25.0, z]];
        let corners = [row(-5.0, edge), row(9.8, bend), row(25.0, edge)].concat();
        let triangles = vec![[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]];
        let roof = Surface::new(corners, triangles).expect("a roof");
        let whole = part(&mesh, &roof).expect("parted");
        assert_eq!(n_bodies(&whole.mesh), 2, "bend at {bend}");
        assert_conforming(&whole.mesh);
        assert!(least_dihedral(&whole.mesh) >= 5.0, "{}", least_dihedral(&whole.mesh));
        assert!((volume(&whole.mesh) / volume(&mesh) - 1.0).abs() < 1e-2);
    }
}

#[test]
fn a_curved_parting_surface_makes_a_crack_that_is_as_smooth() {
    let mesh = block();
    // A quarter of a cylinder's wall of radius 14 about the y axis, in facets of 3 degrees.
    let row = |k: u32| {
        let angle = (f64::from(k) * 3.0 - 60.0).to_radians();
        let (x, z) = (10.0 + 14.0 * angle.sin(), -4.0 + 14.0 * angle.cos());
        [[x, -5.0, z], [x, 25.0, z]]
    };
    let corners: Vec<[f64; 3]> = (0..41).flat_map(row).collect();
    let quads = (0..40).map(|k| 2 * k);
    let triangles = quads.flat_map(|v| [[v, v + 2, v + 1], [v + 1, v + 2, v + 3]]).collect();
    let wall = Surface::new(corners, triangles).expect("a wall");
    let split = part(&mesh, &wall).expect("parted");
    assert_eq!(n_bodies(&split.mesh), 2);
    assert_conforming(&split.mesh);
    assert!(least_dihedral(&split.mesh) >= 5.0, "{}", least_dihedral(&split.mesh));
    let from_axis = |x: &[f64; 3]| (x[0] - 10.0).hypot(x[2] + 4.0);
    let new = &split.mesh.nodes()[mesh.n_nodes()..];
    // The sagitta of a facet is 0.005, and that of an edge of the mesh at most 0.1.
    assert!(new.iter().all(|x| (from_axis(x) - 14.0).abs() < 0.1));
}

/// A block of 20 voxels along each axis in tets of 3 mm.
fn block() -> TetMesh {
    let grid = Grid::new([20, 20, 20], [1.0; 3], [0.0; 3]).expect("a grid");
    let level = LevelImage::from_labels(grid, &[true; 8000]).expect("a level");
    stuff(&level, &options(3.0, 0), &Halvings::default()).expect("a mesh").mesh
}

fn n_bodies(mesh: &TetMesh) -> usize {
    let mut body: Vec<usize> = (0..mesh.n_nodes()).collect();
    fn root(body: &mut [usize], mut v: usize) -> usize {
        while body[v] != v {
            body[v] = body[body[v]];
            v = body[v];
        }
        v
    }
    for tet in mesh.tets() {
        for &v in &tet[1..] {
            let (a, b) = (root(&mut body, tet[0] as usize), root(&mut body, v as usize));
            body[a] = b;
        }
    }
    (0..body.len()).filter(|&v| body[v] == v).count()
}

#[test]
fn bad_input_is_named() {
    let grid = Grid::new([4; 3], [1.0; 3], [0.0; 3]).expect("a grid");
    assert!(matches!(Grid::new([4, 0, 4], [1.0; 3], [0.0; 3]), Err(MtmError::Empty { .. })));
    assert!(matches!(
        Grid::new([4; 3], [1.0, -1.0, 1.0], [0.0; 3]),
        Err(MtmError::OutOfRange { index: 1, .. })
    ));
    assert!(matches!(LevelImage::new(grid, vec![0.0; 63]), Err(MtmError::Length { .. })));
    let mut values = vec![-1.0; 64];
    values[5] = f32::NAN;
    assert!(matches!(LevelImage::new(grid, values), Err(MtmError::NotFinite { index: 5, .. })));
    let empty = LevelImage::new(grid, vec![-1.0; 64]).expect("a level");
    assert!(matches!(
        stuff(&empty, &options(3.0, 0), &Halvings::default()),
        Err(MtmError::Empty { .. })
    ));
    let level = LevelImage::new(grid, vec![1.0; 64]).expect("a level");
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-4] {
        assert!(
            matches!(
                stuff(&level, &options(bad, 0), &Halvings::default()),
                Err(MtmError::OutOfRange { .. })
            ),
            "{bad}"
        );
    }
    assert!(matches!(
        stuff(&level, &options(3.0, 9), &Halvings::default()),
        Err(MtmError::OutOfRange { .. })
    ));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn graded_meshes_of_random_blobs_have_good_shapes(
        centres in prop::collection::vec(prop::array::uniform3(6.0..26.0_f64), 1..5),
        radii in prop::collection::vec(1.0..7.0_f64, 5),
        edge in 2.0..5.0_f64,
        refinements in 0..3_u32,
    ) {
        let level = image(32, 1.0, |x| {
            centres.iter().zip(&radii).map(|(&c, r)| r - radius(x, c)).fold(f64::NEG_INFINITY, f64::max)
        });
        if let Ok(Stuffed { mesh, .. }) = stuff(&level, &options(edge, refinements), &Halvings::default()) {
            prop_assert!(least_dihedral(&mesh) >= 10.0, "{}", least_dihedral(&mesh));
            assert_conforming(&mesh);
        }
    }
}

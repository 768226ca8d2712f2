//! Writes the generated face-like shell as `.npy` files, for programs that are not Rust.
//!
//! `cargo run --release -p mtm-core --example shell_case -- 300000 OUT_FOLDER`

#[path = "../../../benches/scenes/shell.rs"]
mod shell;

use std::error::Error;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [n_tets, folder] = arguments.as_slice() else {
        return Err("expected two arguments: the number of tets and the output folder".into());
    };
    let n_tets: usize = n_tets.parse().map_err(|e| format!("number of tets '{n_tets}': {e}"))?;
    let case = shell::Shell::generate(n_tets);
    case.write(&PathBuf::from(folder))?;
    println!(
        "{} nodes, {} tets, {} fixed, {} joined, {} sliding, {} contact triangles, {} skin nodes",
        case.nodes.len(),
        case.tets.len(),
        case.fixed.len(),
        case.joined.len(),
        case.sliding.len(),
        case.contact_triangles.len(),
        case.skin.len()
    );
    Ok(())
}

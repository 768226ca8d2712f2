//! Compiles METIS (`metis/README.md`) where the feature `metis` is on.

fn main() -> Result<(), String> {
    println!("cargo:rerun-if-changed=build.rs");
    #[cfg(feature = "metis")]
    metis::compile()?;
    Ok(())
}

#[cfg(feature = "metis")]
mod metis {
    use std::env;
    use std::path::{Path, PathBuf};
    use std::process::Command;

    /// The crate that has the sources, and its folder of them.
    const CRATE: &str = "metis-sys";
    const VENDOR: &str = "vendor";
    /// The files that a nested dissection needs, by folder.
    const LIBMETIS: [&str; 24] = [
        "auxapi.c",
        "balance.c",
        "bucketsort.c",
        "coarsen.c",
        "compress.c",
        "contig.c",
        "debug.c",
        "fm.c",
        "fortran.c",
        "gklib.c",
        "graph.c",
        "initpart.c",
        "mcutil.c",
        "mincover.c",
        "mmd.c",
        "ometis.c",
        "options.c",
        "refine.c",
        "separator.c",
        "sfm.c",
        "srefine.c",
        "timing.c",
        "util.c",
        "wspace.c",
    ];
    const GKLIB: [&str; 5] = ["error.c", "mcore.c", "memory.c", "random.c", "timers.c"];

    pub fn compile() -> Result<(), String> {
        let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("metis");
        println!("cargo:rerun-if-changed={}", own.display());
        let vendor = vendored_sources()?;
        let (libmetis, gklib) = (vendor.join("metis/libmetis"), vendor.join("GKlib"));
        let mut build = cc::Build::new();
        build.files(LIBMETIS.iter().map(|name| libmetis.join(name)));
        build.files(GKLIB.iter().map(|name| gklib.join(name)));
        build.file(own.join("absent.c"));
        build.include(vendor.join("metis/include")).include(&libmetis).include(&gklib);
        let sorting = own.join("sorting.h");
        let msvc = env::var("CARGO_CFG_TARGET_ENV").as_deref() == Ok("msvc");
        if msvc {
            build.flag(format!("/FI{}", sorting.display()));
        } else {
            build.flag("-include").flag(sorting);
        }
        // 32-bit indices, as `src/ordering.rs` passes them. NDEBUG leaves its assertions out.
        build.define("IDXTYPEWIDTH", "32").define("REALTYPEWIDTH", "32");
        build.define("NDEBUG", None).define("NDEBUG2", None);
        match env::var("CARGO_CFG_TARGET_OS").as_deref() {
            Ok("linux") => {
                build.define("LINUX", None).define("_FILE_OFFSET_BITS", "64");
            }
            Ok("macos") => {
                build.define("MACOS", None);
            }
            Ok("windows") => {
                build.define("WIN32", None).include(&own);
                if msvc {
                    build.define("MSC", None).define("__thread", "__declspec(thread)");
                }
            }
            _ => {}
        }
        build.warnings(false);
        // Debug builds solve real meshes in tests, too; the linters, without optimisation, run nothing.
        if env::var("OPT_LEVEL").as_deref() != Ok("0") {
            build.opt_level(3);
        }
        build.try_compile("cmfsim_metis").map_err(|error| format!("METIS: {error}"))
    }

    /// The folder of the sources inside the crate that cargo fetched for this build.
    fn vendored_sources() -> Result<PathBuf, String> {
        // Without the network first: cargo has what the build needs, but for crates of tests, which it
        // may have to fetch to answer.
        let found = manifest(&["--offline"]).or_else(|_| manifest(&[]));
        let manifest = found.map_err(|error| format!("the sources of METIS: {error}"))?;
        let vendor = manifest.with_file_name(VENDOR);
        if vendor.is_dir() {
            Ok(vendor)
        } else {
            Err(format!("{}: no such folder, so METIS cannot be compiled", vendor.display()))
        }
    }

    /// The manifest of the crate, as `cargo metadata` states it.
    fn manifest(options: &[&str]) -> Result<PathBuf, String> {
        let cargo = env::var_os("CARGO").ok_or("cargo does not state where it is")?;
        let target = env::var("TARGET").map_err(|error| error.to_string())?;
        let done = Command::new(cargo)
            .args(["metadata", "--format-version", "1", "--filter-platform", &target])
            .args(["--features", "metis"])
            .args(options)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .output()
            .map_err(|error| format!("cargo metadata cannot be run: {error}"))?;
        if !done.status.success() {
            return Err(String::from_utf8_lossy(&done.stderr).into_owned());
        }
        let text = String::from_utf8_lossy(&done.stdout);
        // One key of one package: no reader of JSON is compiled for it.
        text.split("\"manifest_path\":\"")
            .skip(1)
            .filter_map(|rest| rest.split('"').next())
            .map(|path| PathBuf::from(path.replace("\\\\", "\\")))
            .find(|path| {
                let folder = path.parent().and_then(Path::file_name);
                folder.is_some_and(|name| name.to_string_lossy().starts_with(CRATE))
            })
            .ok_or_else(|| format!("cargo metadata names no crate {CRATE}"))
    }
}

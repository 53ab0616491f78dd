//! lavender.c by the C compiler that CC names, else cc, and AR or ar: no crate is needed for one file.
use std::{env, path::PathBuf, process::Command};

fn run(command: &mut Command) {
    let shown = format!("{command:?}");
    let status = command.status().unwrap_or_else(|error| panic!("{shown}: {error}; a C compiler is needed (CC, AR)"));
    assert!(status.success(), "{shown} failed");
}

fn main() {
    println!("cargo:rerun-if-changed=c/lavender.c");
    println!("cargo:rerun-if-env-changed=CC");
    let out = PathBuf::from(env::var("OUT_DIR").expect("cargo sets OUT_DIR"));
    let (object, archive) = (out.join("lavender.o"), out.join("liblavender.a"));
    let tool = |name: &str, usual: &str| env::var(name).unwrap_or_else(|_| usual.to_string());
    let flags = ["-std=c11", "-O3", "-fPIC", "-ffp-contract=off", "-c", "c/lavender.c", "-o"];
    let cc = tool("CC", "cc");
    let mut words = cc.split_whitespace();
    run(Command::new(words.next().expect("CC is empty")).args(words).args(flags).arg(&object));
    run(Command::new(tool("AR", "ar")).arg("crs").arg(&archive).arg(&object));
    println!("cargo:rustc-link-search=native={}", out.display());
    println!("cargo:rustc-link-lib=static=lavender");
    if env::var("CARGO_CFG_UNIX").is_ok() {
        println!("cargo:rustc-link-lib=m");
    }
}

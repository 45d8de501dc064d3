//! jigsaw
fn main() {}

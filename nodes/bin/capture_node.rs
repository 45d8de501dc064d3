//! capture_node
fn main() {}

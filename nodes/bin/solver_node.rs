//! solver_node
fn main() {}

//! feature_node
fn main() {}

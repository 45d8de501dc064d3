//! Isthmus distance functions.

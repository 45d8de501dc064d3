//! Middleware glue: everything that knows DDS, and nothing that knows jigsaw puzzles beyond the names of the topics.
//!
//! Arrows point one way: [`process`] joins its domain (`participant`) and opens [`session`]s; what a session can do beyond topics ([`actions`], [`kept`],
//! [`lifecycle`], [`raw`], `server`, [`services`]) stands beside it and is not known to it.
//!
//! | module | what stands there, and nowhere else |
//! | --- | --- |
//! | **a process** | |
//! | [`process`] | one process: signals, nodes, end |
//! | `participant` | how it joins its domain and leaves it: interfaces, static peers, security |
//! | `security` | keystore and enclave of SROS2 |
//! | `watchdog` | a process that has gone deaf, or whose loop stands still |
//! | [`exit`] | why a process ends, and its exit code |
//! | **what it is told** | |
//! | [`arguments`] | the command line of ROS; in it names and what remaps them, and values given to parameters there and in files |
//! | [`params`] | declaration, check and documentation of parameters |
//! | [`node_params`] | the parameters that every node has |
//! | **a node** | |
//! | [`session`] | one node: opens topics as streams and sinks |
//! | [`topics`] | every topic: message type, name, quality of service |
//! | [`discovery`] | who listens, who offers or asks for too little, who was forgotten and comes back |
//! | [`activity`] | whether a node works now, and what becomes of its inputs while it does not |
//! | [`clock`] | the system's time, or that of `/clock` |
//! | [`health`] | counters of a node, published as `/diagnostics` |
//! | [`logging`] | log lines to the console and `/rosout`, throttled warnings |
//! | **what a node can do beside** | |
//! | `server` | one service: requests in, answers out |
//! | [`services`] | the six parameter services |
//! | [`lifecycle`] | states and transitions of a managed node |
//! | [`actions`] | goals as a stream |
//! | [`kept`] | latched pieces, and which of them are forgotten |
//! | [`raw`] | topics whose type is known by name only |
//! | [`transforms`] | pixels (y down) to metres (y up) |
//! | **what RustDDS leaves undone** | |
//! | [`mends`] | done beside it, each to be deleted when it is mended there |

pub mod actions;
pub mod activity;
pub mod arguments;
pub mod clock;
pub mod discovery;
pub mod exit;
pub mod health;
pub mod kept;
pub mod lifecycle;
pub mod logging;
pub mod mends;
pub mod node_params;
pub mod params;
mod participant;
pub mod process;
pub mod raw;
mod security;
mod server;
pub mod services;
pub mod session;
pub mod topics;
pub mod transforms;
mod watchdog;

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
//! | `turn` | the processes of a host join a domain one after the other |
//! | `security` | keystore and enclave of SROS2 |
//! | [`peers`] | discovery without multicast |
//! | `farewell` | says that a process leaves |
//! | `watchdog` | a process that has gone deaf, or whose loop stands still |
//! | [`exit`] | why a process ends, and its exit code |
//! | **what it is told** | |
//! | [`args`] | the command line of ROS |
//! | [`names`] | names of nodes, topics and services, and what remaps them |
//! | [`assignments`] | values given to parameters on the command line and in files |
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
//! | `large` | answers that do not fit a datagram |
//! | `missed` | asks a client's writer for the request that came before it was known |
//! | [`services`] | the six parameter services |
//! | [`lifecycle`] | states and transitions of a managed node |
//! | [`actions`] | goals as a stream |
//! | [`kept`] | latched pieces, and which of them are forgotten |
//! | [`raw`] | topics whose type is known by name only |
//! | [`transforms`] | pixels (y down) to metres (y up) |

pub mod actions;
pub mod activity;
pub mod args;
pub mod assignments;
pub mod clock;
pub mod discovery;
pub mod exit;
mod farewell;
pub mod health;
pub mod kept;
mod large;
pub mod lifecycle;
pub mod logging;
mod missed;
pub mod names;
pub mod node_params;
pub mod params;
mod participant;
pub mod peers;
pub mod process;
pub mod raw;
mod security;
mod server;
pub mod services;
pub mod session;
pub mod topics;
pub mod transforms;
mod turn;
mod watchdog;

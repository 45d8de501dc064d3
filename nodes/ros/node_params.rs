//! Parameters of every node.

use std::net::{IpAddr, Ipv4Addr};

use super::params::{Default, Rule, Spec};

/// Whether a node starts to work by itself.
pub const AUTOSTART: Spec = Spec {
    name: "autostart",
    default: Default::Bool(true),
    unit: "",
    rule: Rule::Any,
    description: "Configure and activate the node when it starts; otherwise it waits, unconfigured, for a lifecycle manager.",
    read_only: true,
};

/// Whether the time comes from `/clock`.
pub const USE_SIM_TIME: Spec = Spec {
    name: "use_sim_time",
    default: Default::Bool(false),
    unit: "",
    rule: Rule::Any,
    description: "Take the time from /clock instead of the system.",
    read_only: false,
};

/// Which interfaces the middleware uses.
pub const NETWORK_INTERFACES: Spec = Spec {
    name: "network_interfaces",
    default: Default::Texts(&[]),
    unit: "",
    rule: Rule::Texts("IP addresses of this host", |text| text.parse::<IpAddr>().is_ok()),
    description: "Addresses of the network interfaces to talk through; all of them if empty, 127.0.0.1 for this host alone.",
    read_only: true,
};

/// How much memory the process may take.
pub const MAXIMUM_MEMORY: Spec = Spec {
    name: "maximum_memory",
    default: Default::Integer(4096),
    unit: "MiB",
    rule: Rule::Integers(0, 1 << 20),
    description: "Address space that the process may take; beyond it ends, to be started again, so that malformed network \
                  packets can't take all memory; 0 for no limit.",
    read_only: true,
};

/// Hosts that multicast does not reach.
pub const STATIC_PEERS: Spec = Spec {
    name: "static_peers",
    default: Default::Texts(&[]),
    unit: "",
    rule: Rule::Texts("IPv4 addresses", |text| text.parse::<Ipv4Addr>().is_ok()),
    description: "Addresses of hosts that this process announces itself to by unicast, for networks without multicast; \
                  to be set on all hosts. Without, the environment's ROS_STATIC_PEERS is taken (separated by ';').",
    read_only: true,
};

/// The parameters every node has.
pub const COMMON_PARAMETERS: &[Spec] = &[AUTOSTART, USE_SIM_TIME, NETWORK_INTERFACES, MAXIMUM_MEMORY, STATIC_PEERS];

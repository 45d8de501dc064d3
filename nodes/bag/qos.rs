//! Offered QoS profiles as rosbag2 stores them: a YAML list per topic, in `metadata.yaml` and in the storage file.
//!
//! Until version 8 of the format the enums are the numbers of `rmw` and the list is one YAML string; from version 9 on
//! they are lower-case names and the list is YAML proper. Both are read, version 9 is written. Only what changes
//! whether two endpoints match is kept; deadlines, lifespans and leases are written as "infinite".

use serde::{Deserialize, Serialize};

/// How many samples an endpoint keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum History {
    /// The last `depth` samples.
    KeepLast,
    /// All samples, as far as resources allow.
    KeepAll,
    /// The bag does not say.
    Unknown,
}

/// Whether lost samples are repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Reliability {
    /// Lost samples are repeated until acknowledged.
    Reliable,
    /// Lost samples stay lost.
    BestEffort,
    /// The bag does not say.
    Unknown,
}

/// Whether late joiners get earlier samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Durability {
    /// Late joiners get the samples the writer still keeps ("latched").
    TransientLocal,
    /// Late joiners get nothing from before they joined.
    Volatile,
    /// The bag does not say.
    Unknown,
}

/// One offered QoS profile of a recorded topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct QosProfile {
    /// History kind.
    pub history: History,
    /// History depth \[samples\]; has a meaning for [`History::KeepLast`] only.
    pub depth: u32,
    /// Reliability kind.
    pub reliability: Reliability,
    /// Durability kind.
    pub durability: Durability,
}

impl QosProfile {
    /// Reliable and volatile with a history of `depth` samples: what a ROS publisher offers unless told otherwise.
    #[must_use]
    pub fn reliable(depth: u32) -> Self {
        Self { history: History::KeepLast, depth, reliability: Reliability::Reliable, durability: Durability::Volatile }
    }

    /// Best effort and volatile, as sensors publish.
    #[must_use]
    pub fn best_effort(depth: u32) -> Self {
        Self { reliability: Reliability::BestEffort, ..Self::reliable(depth) }
    }

    /// Reliable and transient local: late joiners get the last `depth` samples.
    #[must_use]
    pub fn latched(depth: u32) -> Self {
        Self { durability: Durability::TransientLocal, ..Self::reliable(depth) }
    }
}

/// A profile as YAML spells it. Unknown keys are ignored, missing ones are "unknown".
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct YamlProfile {
    #[serde(default)]
    history: NameOrNumber,
    #[serde(default)]
    depth: u32,
    #[serde(default)]
    reliability: NameOrNumber,
    #[serde(default)]
    durability: NameOrNumber,
    #[serde(default = "YamlTime::infinite", skip_deserializing)]
    deadline: YamlTime,
    #[serde(default = "YamlTime::infinite", skip_deserializing)]
    lifespan: YamlTime,
    #[serde(default = "NameOrNumber::automatic", skip_deserializing)]
    liveliness: NameOrNumber,
    #[serde(default = "YamlTime::infinite", skip_deserializing)]
    liveliness_lease_duration: YamlTime,
    #[serde(default)]
    avoid_ros_namespace_conventions: bool,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(untagged)]
enum NameOrNumber {
    Name(String),
    Number(i64),
}

impl Default for NameOrNumber {
    fn default() -> Self {
        Self::Name("unknown".to_owned())
    }
}

impl NameOrNumber {
    fn automatic() -> Self {
        Self::Name("automatic".to_owned())
    }

    /// Whether this is `name`, or `number` of the rmw enum.
    fn is(&self, name: &str, number: i64) -> bool {
        match self {
            Self::Name(s) => s.eq_ignore_ascii_case(name),
            Self::Number(n) => *n == number,
        }
    }
}

#[derive(Debug, Clone, Serialize)]
struct YamlTime {
    sec: i64,
    nsec: i64,
}

impl YamlTime {
    /// rmw's "infinite" duration: the largest number of nanoseconds.
    fn infinite() -> Self {
        Self { sec: i64::MAX / 1_000_000_000, nsec: i64::MAX % 1_000_000_000 }
    }
}

impl From<&QosProfile> for YamlProfile {
    fn from(profile: &QosProfile) -> Self {
        let name = |s: &str| NameOrNumber::Name(s.to_owned());
        Self {
            history: match profile.history {
                History::KeepLast => name("keep_last"),
                History::KeepAll => name("keep_all"),
                History::Unknown => name("unknown"),
            },
            depth: profile.depth,
            reliability: match profile.reliability {
                Reliability::Reliable => name("reliable"),
                Reliability::BestEffort => name("best_effort"),
                Reliability::Unknown => name("unknown"),
            },
            durability: match profile.durability {
                Durability::TransientLocal => name("transient_local"),
                Durability::Volatile => name("volatile"),
                Durability::Unknown => name("unknown"),
            },
            deadline: YamlTime::infinite(),
            lifespan: YamlTime::infinite(),
            liveliness: NameOrNumber::automatic(),
            liveliness_lease_duration: YamlTime::infinite(),
            avoid_ros_namespace_conventions: false,
        }
    }
}

impl From<&YamlProfile> for QosProfile {
    // The numbers are those of rmw/types.h.
    fn from(yaml: &YamlProfile) -> Self {
        Self {
            history: if yaml.history.is("keep_last", 1) {
                History::KeepLast
            } else if yaml.history.is("keep_all", 2) {
                History::KeepAll
            } else {
                History::Unknown
            },
            depth: yaml.depth,
            reliability: if yaml.reliability.is("reliable", 1) {
                Reliability::Reliable
            } else if yaml.reliability.is("best_effort", 2) {
                Reliability::BestEffort
            } else {
                Reliability::Unknown
            },
            durability: if yaml.durability.is("transient_local", 1) {
                Durability::TransientLocal
            } else if yaml.durability.is("volatile", 2) {
                Durability::Volatile
            } else {
                Durability::Unknown
            },
        }
    }
}

/// Reads the YAML list of profiles; text that is none yields no profile, since playing falls back to "reliable" then.
pub(super) fn parse_profiles(yaml: &str) -> Vec<QosProfile> {
    serde_yaml_ng::from_str::<Vec<YamlProfile>>(yaml)
        .map(|list| list.iter().map(QosProfile::from).collect())
        .unwrap_or_default()
}

/// Writes profiles as the YAML list of version 9.
pub(super) fn profiles_to_yaml(profiles: &[QosProfile]) -> String {
    let list: Vec<YamlProfile> = profiles.iter().map(YamlProfile::from).collect();
    if list.is_empty() { String::new() } else { serde_yaml_ng::to_string(&list).unwrap_or_default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_survive_a_round_trip() {
        let profiles = vec![
            QosProfile::reliable(10),
            QosProfile::best_effort(5),
            QosProfile::latched(1),
            QosProfile {
                history: History::KeepAll,
                depth: 0,
                reliability: Reliability::Unknown,
                durability: Durability::Unknown,
            },
        ];
        assert_eq!(parse_profiles(&profiles_to_yaml(&profiles)), profiles);
    }

    #[test]
    fn numbers_of_version_8_are_understood() {
        let yaml =
            "- {history: 1, depth: 7, reliability: 2, durability: 1, deadline: {sec: 1, nsec: 2}, liveliness: 1}";
        assert_eq!(
            parse_profiles(yaml),
            vec![QosProfile {
                history: History::KeepLast,
                depth: 7,
                reliability: Reliability::BestEffort,
                durability: Durability::TransientLocal,
            }]
        );
    }

    #[test]
    fn nonsense_is_no_profile() {
        assert_eq!(parse_profiles("}{"), vec![]);
        assert_eq!(parse_profiles(""), vec![]);
    }
}

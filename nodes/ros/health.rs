//! What a node reports of itself: counters, refusals, the last error; published as `/diagnostics` at 1 Hz.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use jigsaw_msgs::diagnostic_msgs::msg::{DiagnosticStatus, KeyValue};

use super::logging::Throttle;

/// Counters of a node, shared by its loop and the reporter.
#[derive(Debug)]
pub struct Health {
    node: String,
    inner: Mutex<Inner>,
}

#[derive(Debug)]
struct Inner {
    received: u64,
    published: u64,
    refused: BTreeMap<&'static str, u64>,
    state: String,
    lifecycle: String,
    last_error: Option<(Instant, String)>,
    figures: BTreeMap<&'static str, String>,
    throttle: Throttle,
    last_report: (Instant, u64, u64),
}

/// How long after the last refusal or error a node still reports a warning.
const WARNING_SECONDS: u64 = 10;

/// Most characters of a text that a refusal repeats.
const MOST_SHOWN: usize = 40;

/// A text of someone else's as a refusal repeats it: not longer than a line, without control characters.
pub fn shown(text: &str) -> String {
    let mut short: String =
        text.chars().take(MOST_SHOWN).map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    short
}

/// Label of the state in which a node works; see [`super::lifecycle`].
const ACTIVE: &str = "active";

/// On which host the node runs; several may share the work.
fn host_name() -> String {
    nix::unistd::gethostname().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

impl Health {
    /// Counters of the node of this full name, all at zero.
    pub fn new(node: &str) -> Self {
        Self {
            node: node.to_owned(),
            inner: Mutex::new(Inner {
                received: 0,
                published: 0,
                refused: BTreeMap::new(),
                state: "waiting for input".to_owned(),
                lifecycle: ACTIVE.to_owned(),
                last_error: None,
                figures: BTreeMap::new(),
                throttle: Throttle::default(),
                last_report: (Instant::now(), 0, 0),
            }),
        }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts an input that was taken.
    pub fn received(&self) {
        self.inner().received += 1;
    }

    /// Counts an output.
    pub fn published(&self) {
        self.inner().published += 1;
    }

    /// Counts an input that was refused, and logs the reason unless the same kind was logged a moment ago.
    pub fn refuse(&self, kind: &'static str, reason: &str) {
        let mut inner = self.inner();
        *inner.refused.entry(kind).or_default() += 1;
        inner.warn(kind, reason);
    }

    /// Logs a warning (throttled by kind) and reports it, without counting a refusal.
    pub fn warn(&self, kind: &str, message: &str) {
        self.inner().warn(kind, message);
    }

    /// Says in a few words what the node is doing.
    pub fn state(&self, state: &str) {
        let mut inner = self.inner();
        if inner.state != state {
            inner.state = state.to_owned();
        }
    }

    /// Says in which state of the lifecycle the node is.
    pub fn lifecycle(&self, label: &str) {
        label.clone_into(&mut self.inner().lifecycle);
    }

    /// Sets a figure of the report.
    pub fn figure(&self, name: &'static str, value: impl ToString) {
        self.inner().figures.insert(name, value.to_string());
    }

    /// How many inputs were refused so far.
    pub fn refusals(&self) -> u64 {
        self.inner().refused.values().sum()
    }

    /// The report of this moment. Rates are means since the last report.
    pub fn report(&self) -> DiagnosticStatus {
        let mut inner = self.inner();
        let now = Instant::now();
        let (then, received, published) = inner.last_report;
        let seconds = now.duration_since(then).as_secs_f64().max(f64::EPSILON);
        let rate = |count: u64, before: u64| format!("{:.1}", (count - before) as f64 / seconds);
        let mut values = vec![
            ("lifecycle", inner.lifecycle.clone()),
            ("state", inner.state.clone()),
            ("received", inner.received.to_string()),
            ("received_per_second", rate(inner.received, received)),
            ("published", inner.published.to_string()),
            ("published_per_second", rate(inner.published, published)),
            ("refused", inner.refused.values().sum::<u64>().to_string()),
        ];
        values.extend(inner.figures.iter().map(|(&name, value)| (name, value.clone())));
        let mut values: Vec<KeyValue> =
            values.into_iter().map(|(key, value)| KeyValue { key: key.to_owned(), value }).collect();
        values.extend(
            inner.refused.iter().map(|(kind, n)| KeyValue { key: format!("refused.{kind}"), value: n.to_string() }),
        );
        let recent = inner
            .last_error
            .as_ref()
            .filter(|(when, _)| now.duration_since(*when).as_secs() < WARNING_SECONDS)
            .map(|(_, error)| error.clone());
        values.push(KeyValue {
            key: "last_error".to_owned(),
            value: inner.last_error.as_ref().map(|(_, error)| error.clone()).unwrap_or_default(),
        });
        inner.last_report = (now, inner.received, inner.published);
        DiagnosticStatus {
            level: if recent.is_some() { DiagnosticStatus::WARN } else { DiagnosticStatus::OK },
            name: self.node.trim_start_matches('/').to_owned(),
            message: recent.unwrap_or_else(|| {
                if inner.lifecycle == ACTIVE { inner.state.clone() } else { inner.lifecycle.clone() }
            }),
            hardware_id: host_name(),
            values,
        }
    }
}

impl Inner {
    fn warn(&mut self, kind: &str, message: &str) {
        let now = Instant::now();
        if let Some(held_back) = self.throttle.pass(kind, now) {
            if held_back == 0 {
                log::warn!("{message}");
            } else {
                log::warn!("{message} ({held_back} more of this kind since the last line)");
            }
        }
        self.last_error = Some((now, message.to_owned()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(status: &DiagnosticStatus, key: &str) -> String {
        status.values.iter().find(|v| v.key == key).unwrap().value.clone()
    }

    #[test]
    fn a_refusal_is_counted_and_reported() {
        let health = Health::new("/cell/solver_node");
        assert_eq!(health.report().level, DiagnosticStatus::OK);
        health.received();
        health.refuse("border", "border of 'a' holds NaN");
        health.refuse("border", "border of 'b' holds NaN");
        health.figure("pieces", 3);
        health.lifecycle("inactive");
        let report = health.report();
        assert_eq!(report.name, "cell/solver_node");
        assert_eq!(report.level, DiagnosticStatus::WARN);
        assert_eq!(report.message, "border of 'b' holds NaN");
        assert_eq!(value(&report, "refused"), "2");
        assert_eq!(value(&report, "refused.border"), "2");
        assert_eq!(value(&report, "received"), "1");
        assert_eq!(value(&report, "pieces"), "3");
        assert_eq!(value(&report, "lifecycle"), "inactive");
        assert_eq!(report.hardware_id, host_name());
        assert!(!report.hardware_id.is_empty());
    }
}

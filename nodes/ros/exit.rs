//! How a process ends.
//!
//! | exit code | meaning |
//! | --- | --- |
//! | 0 | ended by SIGINT or SIGTERM, or done |
//! | 1 | the middleware could not be opened |
//! | 2 | bad command line, parameter or environment; one line says what |
//! | 3 | the node had gone deaf, or to some, or stood still (see `watchdog` and [`super::discovery`]), and is to be started again |

use std::process::ExitCode;

use super::arguments::ArgsError;
use super::discovery::Estranged;
use super::params::ParameterError;
use super::session::SessionError;
use super::watchdog;
use crate::console::complain;

/// Why a process ends, other than by a signal.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProcessError {
    /// The command line or the environment.
    #[error(transparent)]
    Args(#[from] ArgsError),
    /// A parameter's start-up value.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The configuration of a node, beyond the rules of single parameters.
    #[error("{0}")]
    Configuration(String),
    /// The middleware, or a name.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The system.
    #[error("{what}: {reason}")]
    System {
        /// What was tried.
        what: &'static str,
        /// The system's words.
        reason: String,
    },
    /// A thread of the middleware has ended.
    #[error("the middleware has gone deaf (its thread '{0}' ended, as it does after SIGSTOP); start this node again")]
    Deaf(String),
    /// A call does not return.
    #[error("the node's loop has stood still for {} s; start this node again", watchdog::PATIENCE.as_secs())]
    Stalled,
    /// One that was forgotten has come back.
    #[error(transparent)]
    Estranged(#[from] Estranged),
}

impl ProcessError {
    /// The exit code of the process.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Args(_) | Self::Parameter(_) | Self::Configuration(_) | Self::Session(SessionError::Name(_)) => 2,
            Self::Session(_) | Self::System { .. } => 1,
            Self::Deaf(_) | Self::Stalled | Self::Estranged(_) => 3,
        }
    }
}

/// Says what went wrong, in one line, and gives the exit code for it.
pub fn exit_code(program: &str, result: Result<(), ProcessError>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => told(program, &error).into(),
    }
}

/// Says what went wrong, and gives the exit code for it.
pub(super) fn told(program: &str, error: &ProcessError) -> u8 {
    complain!("{program}: {error}");
    error.exit_code()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_another_start_mends_has_a_code_of_its_own() {
        let faults = [
            ProcessError::Deaf("RustDDS event loop".to_owned()),
            ProcessError::Stalled,
            Estranged::CameBack("1".to_owned()).into(),
            Estranged::NotLetIn("1".to_owned()).into(),
        ];
        for fault in faults {
            assert_eq!(fault.exit_code(), 3, "{fault}");
            assert!(fault.to_string().contains("start"), "{fault}");
        }
        assert_eq!(ProcessError::Configuration("a mistake".to_owned()).exit_code(), 2);
        assert_eq!(ProcessError::System { what: "a call", reason: "refused".to_owned() }.exit_code(), 1);
        assert!(ProcessError::Stalled.to_string().contains("30 s"));
    }
}

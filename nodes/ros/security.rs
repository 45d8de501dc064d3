//! DDS Security after SROS2: which keystore and enclave the environment names.
//!
//! | variable | meaning |
//! | --- | --- |
//! | `ROS_SECURITY_ENABLE` | `true` switches security on; anything else, or nothing, leaves it off |
//! | `ROS_SECURITY_KEYSTORE` | folder of the keystore; the files of an enclave lie in `enclaves/<enclave>/` |
//! | `ROS_SECURITY_STRATEGY` | `Enforce`: a node without a whole enclave does not start; otherwise it starts unprotected, with a warning |
//! | `ROS_SECURITY_ENCLAVE_OVERRIDE` | enclave of this process, before `--enclave`; `/` where neither is given |
//!
//! Security is built in with the feature `security`. A build without it takes an order to be secure for a missing enclave.

use std::path::{Path, PathBuf};

use rustdds::DomainParticipantBuilder;

use super::arguments::ArgsError;

/// The files of an enclave, as SROS2 names them.
const FILES: [&str; 6] =
    ["identity_ca.cert.pem", "cert.pem", "key.pem", "permissions_ca.cert.pem", "governance.p7s", "permissions.p7s"];

const ENABLE: &str = "ROS_SECURITY_ENABLE";
const KEYSTORE: &str = "ROS_SECURITY_KEYSTORE";
const STRATEGY: &str = "ROS_SECURITY_STRATEGY";
const OVERRIDE: &str = "ROS_SECURITY_ENCLAVE_OVERRIDE";

/// The folder of this process's enclave; none where security is off.
///
/// # Errors
/// Under `Enforce`, what is missing.
pub(super) fn enclave(
    given: Option<&str>,
    environment: impl Fn(&'static str) -> Option<String>,
) -> Result<Option<PathBuf>, ArgsError> {
    if environment(ENABLE).as_deref() != Some("true") {
        return Ok(None);
    }
    let name = environment(OVERRIDE).or_else(|| given.map(str::to_owned)).unwrap_or_else(|| "/".to_owned());
    match whole_enclave(&name, environment(KEYSTORE)) {
        Ok(folder) => Ok(Some(folder)),
        Err(error) if environment(STRATEGY).as_deref() == Some("Enforce") => Err(error),
        Err(error) => {
            log::warn!("not secured: {error}");
            Ok(None)
        }
    }
}

/// The participant's builder with the files of an enclave.
#[cfg(feature = "security")]
pub(super) fn secure(builder: DomainParticipantBuilder, enclave: &Path) -> DomainParticipantBuilder {
    use rustdds::DomainParticipantSecurityConfigFiles as Files;
    log::info!("secured by the enclave {}", enclave.display());
    // The keys of SROS2 have no password.
    builder.builtin_security(Files::with_ros_default_names(enclave, String::new()))
}

/// Without the feature there is never an enclave.
#[cfg(not(feature = "security"))]
pub(super) fn secure(builder: DomainParticipantBuilder, _: &Path) -> DomainParticipantBuilder {
    builder
}

fn whole_enclave(name: &str, keystore: Option<String>) -> Result<PathBuf, ArgsError> {
    let wrong = |variable, value: &str, rule| ArgsError::Environment { variable, value: value.to_owned(), rule };
    if cfg!(not(feature = "security")) {
        return Err(wrong(ENABLE, "true", "this build has no security; build with --features security"));
    }
    let Some(keystore) = keystore.filter(|text| !text.is_empty()) else {
        return Err(wrong(KEYSTORE, "", "must name the keystore where ROS_SECURITY_ENABLE is true"));
    };
    let relative = name.trim_matches('/');
    if Path::new(relative).components().any(|part| !matches!(part, std::path::Component::Normal(_))) {
        return Err(wrong(OVERRIDE, name, "an enclave is a path of names within the keystore"));
    }
    let folder = Path::new(&keystore).join("enclaves").join(relative);
    match FILES.iter().map(|file| folder.join(file)).find(|file| !file.is_file()) {
        None => Ok(folder),
        Some(missing) => Err(wrong(KEYSTORE, &missing.display().to_string(), "must be a file of the enclave")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look(given: Option<&str>, variables: &[(&str, &str)]) -> Result<Option<PathBuf>, ArgsError> {
        enclave(given, |name| variables.iter().find(|(key, _)| *key == name).map(|(_, value)| (*value).to_owned()))
    }

    #[test]
    fn security_is_off_unless_it_is_switched_on() {
        assert_eq!(look(Some("/cell"), &[(KEYSTORE, "/no/such")]).unwrap(), None);
        assert_eq!(look(None, &[(ENABLE, "false"), (STRATEGY, "Enforce")]).unwrap(), None);
    }

    #[test]
    fn what_is_missing_is_an_error_under_enforce_and_a_warning_otherwise() {
        let on = [(ENABLE, "true"), (KEYSTORE, "/no/such")];
        assert_eq!(look(None, &on).unwrap(), None);
        let said = look(None, &[on[0], on[1], (STRATEGY, "Enforce")]).unwrap_err().to_string();
        assert!(said.contains("ROS_SECURITY"), "{said}");
    }

    #[cfg(feature = "security")]
    #[test]
    fn an_enclave_lies_within_the_keystore() {
        let keystore = tempfile::tempdir().unwrap();
        let folder = keystore.path().join("enclaves/lab/solver");
        std::fs::create_dir_all(&folder).unwrap();
        FILES.iter().for_each(|file| std::fs::write(folder.join(file), "").unwrap());
        let path = keystore.path().to_str().unwrap();
        let on = [(ENABLE, "true"), (KEYSTORE, path), (STRATEGY, "Enforce")];
        assert_eq!(look(Some("/lab/solver"), &on).unwrap(), Some(folder.clone()));
        let other = [on[0], on[1], on[2], (OVERRIDE, "/lab/other")];
        assert!(look(Some("/lab/solver"), &other).unwrap_err().to_string().contains("lab/other/identity_ca.cert.pem"));
        assert!(look(Some("/../lab"), &on).is_err());
    }
}

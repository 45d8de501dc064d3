//! What RustDDS 0.15 leaves undone or does wrong, done beside it: on sockets of our own, in the name of its participant. Nothing
//! here is needed for its own sake; each module can be deleted when the column on the right is true.
//!
//! | module | what it does | not needed when |
//! | --- | --- | --- |
//! | [`peers`] | discovery without multicast | RustDDS takes a list of peers to announce itself to |
//! | `turn` | the processes of a host join a domain one after the other | announcements bear a time, and handshakes of several participants have a longer history |
//! | `farewell` | says that a process leaves | its own farewell names the participant by key hash and status |
//! | `large` | answers that do not fit a datagram | inline quality of service before fragments can be read |
//! | `missed` | asks a client's writer for the request that came before it was known | its first ACKNACK counts from number 0 |

pub(super) mod farewell;
pub(super) mod large;
pub(super) mod missed;
pub mod peers;
pub(super) mod turn;

//! One process: command line, signals, DDS participant, nodes, watchdog, exit code.
//!
//! | exit code | meaning |
//! | --- | --- |
//! | 0 | ended by SIGINT or SIGTERM, or done |
//! | 1 | the middleware could not be opened |
//! | 2 | bad command line, parameter or environment; one line says what |
//! | 3 | the node had gone deaf, or to some (see below), and is to be started again |
//!
//! **Signals** are blocked on every thread, and one thread waits for them. A handler that ran on one of RustDDS's own
//! threads would interrupt its poll, after which that thread ends for good and the node lives on deaf. SIGSTOP and
//! SIGCONT interrupt polls all the same; so a **watchdog** looks whether RustDDS's threads still live and ends the
//! process where one has gone, so that whoever started it starts it again. Another one does the same where the process's own loop
//! stands still, in a call of the middleware that does not return; and an end waits for the middleware's threads with
//! a limit.
//!
//! **Whoever was forgotten and comes back** (a link was down for longer than the lease, 50 s) stays a stranger: RustDDS
//! has taken its announcements of endpoints once and takes them for known when they come again. A node that sees that ends
//! as well; with its new identity both sides find each other as new.

use std::cell::RefCell;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use futures::channel::oneshot;
use futures::future::LocalBoxFuture;
use futures::{FutureExt, SinkExt, StreamExt};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::diagnostic_msgs::msg::DiagnosticArray;
use jigsaw_msgs::std_msgs::msg::Header;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::{SigSet, Signal};
use ros2_client::{Context, NodeName, NodeOptions};
use rustdds::{DomainParticipant, DomainParticipantBuilder, RTPSEntity};

use super::activity::Activity;
use super::args::{ArgsError, RosArgs, domain_id};
use super::discovery::{Endpoints, Estranged};
use super::farewell::Farewell;
use super::health::Health;
use super::params::{Default as DefaultValue, ParameterError, Parameters, Rule, Spec};
use super::session::{Clock, Session, SessionError};
use super::turn::Turn;
use super::{discovery, logging, peers, security, services, topics};
use crate::console::{complain, say};

/// Whether a node starts to work by itself.
pub const AUTOSTART: Spec = Spec {
    name: "autostart",
    default: DefaultValue::Bool(true),
    unit: "",
    rule: Rule::Any,
    description: "Configure and activate the node when it starts; otherwise it waits, unconfigured, for a lifecycle manager.",
    read_only: true,
};

/// Whether the time comes from `/clock`.
pub const USE_SIM_TIME: Spec = Spec {
    name: "use_sim_time",
    default: DefaultValue::Bool(false),
    unit: "",
    rule: Rule::Any,
    description: "Take the time from /clock instead of the system.",
    read_only: false,
};

/// Which interfaces the middleware uses.
pub const NETWORK_INTERFACES: Spec = Spec {
    name: "network_interfaces",
    default: DefaultValue::Texts(&[]),
    unit: "",
    rule: Rule::Texts("IP addresses of this host", |text| text.parse::<IpAddr>().is_ok()),
    description: "Addresses of the network interfaces to talk through; all of them if empty, 127.0.0.1 for this host alone.",
    read_only: true,
};

/// How much memory the process may take.
pub const MAXIMUM_MEMORY: Spec = Spec {
    name: "maximum_memory",
    default: DefaultValue::Integer(4096),
    unit: "MiB",
    rule: Rule::Integers(0, 1 << 20),
    description: "Address space that the process may take; beyond it ends, to be started again, so that malformed network \
                  packets can't take all memory; 0 for no limit.",
    read_only: true,
};

/// Hosts that multicast does not reach.
pub const STATIC_PEERS: Spec = Spec {
    name: "static_peers",
    default: DefaultValue::Texts(&[]),
    unit: "",
    rule: Rule::Texts("IPv4 addresses", |text| text.parse::<Ipv4Addr>().is_ok()),
    description: "Addresses of hosts that this process announces itself to by unicast, for networks without multicast; \
                  to be set on all hosts. Without, the environment's ROS_STATIC_PEERS is taken (separated by ';').",
    read_only: true,
};

/// The parameters every node has.
pub const COMMON_PARAMETERS: &[Spec] = &[AUTOSTART, USE_SIM_TIME, NETWORK_INTERFACES, MAXIMUM_MEMORY, STATIC_PEERS];

/// How often the watchdog looks.
const WATCH_PERIOD: Duration = Duration::from_millis(500);

/// How many looks of the watchdog the process's loop may stand still: long beyond any work that is done in it, opening
/// the middleware on a busy machine included. Looks and not seconds, so that a process that was stopped is not taken
/// for one that hangs.
const LOOKS: u32 = 60;

/// How often a node reports.
const REPORT_PERIOD: Duration = Duration::from_secs(1);

/// How long an ordered end may take after a signal; then the process ends anyway, so that whoever sent the signal
/// need not kill it.
const END_PATIENCE: Duration = Duration::from_millis(800);

/// How long the middleware may take to end; what it has not done by then is left to the end of the process.
const MIDDLEWARE_PATIENCE: Duration = Duration::from_secs(5);

/// Beginning of the names of RustDDS's threads.
const MIDDLEWARE_THREADS: &str = "RustDDS";

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
    #[error("the node's loop has stood still for {} s; start this node again", (WATCH_PERIOD * LOOKS).as_secs())]
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

/// What a program is, for `--help`.
#[derive(Debug, Clone, Copy)]
pub struct Program {
    /// Name of the binary and of the node.
    pub name: &'static str,
    /// What it does, its topics and services.
    pub about: &'static str,
    /// Its parameters.
    pub parameters: &'static [Spec],
}

/// The work of a process: what runs until it is done or a signal comes.
pub type Work = LocalBoxFuture<'static, Result<(), ProcessError>>;

/// Runs a program of one node: its whole `main`.
pub fn main(program: Program, open: impl FnOnce(Session) -> Result<Work, ProcessError>) -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if args.iter().any(|a| a == "--help" || a == "-h") {
        say!("{}", help(&program));
        return ExitCode::SUCCESS;
    }
    if args.iter().any(|a| a == "--version" || a == "-V") {
        say!("{} {}", program.name, env!("CARGO_PKG_VERSION"));
        return ExitCode::SUCCESS;
    }
    let result = Process::start(program.name, args).and_then(|process| {
        process.only_ros_arguments()?;
        process.started_again().run(|process| open(process.node(program.name, program.parameters)?))
    });
    exit_code(program.name, result)
}

/// Says what went wrong, in one line, and gives the exit code for it.
pub fn exit_code(program: &str, result: Result<(), ProcessError>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => told(program, &error).into(),
    }
}

/// Says what went wrong, and gives the exit code for it.
fn told(program: &str, error: &ProcessError) -> u8 {
    complain!("{program}: {error}");
    error.exit_code()
}

fn help(program: &Program) -> String {
    let mut text = format!(
        "{}\n\nUsage: {} [--ros-args [-r FROM:=TO] [-p NAME:=VALUE] [--params-file FILE]\n       \
         [-r __ns:=/NAMESPACE] [-r __node:=NAME] [--log-level [LOGGER:=]LEVEL] [--]]\n\n\
         Environment: ROS_DOMAIN_ID, ROS_LOCALHOST_ONLY, ROS_AUTOMATIC_DISCOVERY_RANGE, RUST_LOG,\n\
         ROS_SECURITY_ENABLE, ROS_SECURITY_KEYSTORE, ROS_SECURITY_STRATEGY, ROS_SECURITY_ENCLAVE_OVERRIDE\n\nParameters:\n",
        program.about, program.name
    );
    for spec in program.parameters.iter().chain(COMMON_PARAMETERS) {
        let unit = if spec.unit.is_empty() { String::new() } else { format!(" {}", spec.unit) };
        let rule = Some(spec.rule_text()).filter(|r| !r.is_empty()).map(|r| format!("; {r}")).unwrap_or_default();
        text.push_str(&format!(
            "  {} ({} = {}{unit}{rule})\n      {}\n",
            spec.name,
            spec.type_name(),
            super::params::show(&spec.default_value()),
            spec.description
        ));
    }
    text
}

/// A process before and while it runs.
pub struct Process {
    /// Its command line.
    pub args: RosArgs,
    name: &'static str,
    executor: Rc<smol::LocalExecutor<'static>>,
    endpoints: Endpoints,
    participant: Option<(DomainParticipant, Context)>,
    /// Held until this process has joined the domain.
    turn: Option<Turn>,
    /// Said at the end.
    farewell: Option<Farewell>,
    /// Where the work is told that a signal has come, if it wants to end itself.
    ending: Arc<Mutex<Option<oneshot::Sender<()>>>>,
    /// The parameters of all nodes of a composed process: one that another node has is no mistake.
    tables: &'static [&'static [Spec]],
    /// Whether it is started again where it ends by a fault.
    started_again: bool,
}

impl Process {
    /// Blocks the signals, reads the command line and starts logging. To be called before any thread is started.
    ///
    /// # Errors
    /// A bad command line.
    pub fn start(name: &'static str, args: impl IntoIterator<Item = impl Into<String>>) -> Result<Self, ProcessError> {
        signals()
            .thread_block()
            .map_err(|e| ProcessError::System { what: "blocking signals", reason: e.to_string() })?;
        let args = RosArgs::parse(args)?;
        logging::start(name, &args);
        Ok(Self {
            args,
            name,
            executor: Rc::new(smol::LocalExecutor::new()),
            endpoints: Endpoints::default(),
            participant: None,
            turn: None,
            farewell: None,
            ending: Arc::default(),
            tables: &[],
            started_again: false,
        })
    }

    /// Says that several nodes will be opened, with these parameters among them: one that any of them has is then
    /// passed over by the others.
    pub fn composed_of(self, tables: &'static [&'static [Spec]]) -> Self {
        Self { tables, ..self }
    }

    /// Says that whoever started this process starts it again where it ends by a fault.
    pub fn started_again(self) -> Self {
        Self { started_again: true, ..self }
    }

    /// Checks that nothing but ROS arguments was given.
    ///
    /// # Errors
    /// The first other argument.
    pub fn only_ros_arguments(&self) -> Result<(), ProcessError> {
        match self.args.rest.first() {
            None => Ok(()),
            Some(unknown) => Err(ProcessError::Configuration(format!(
                "unknown argument '{unknown}': ROS arguments stand behind --ros-args (see --help)"
            ))),
        }
    }

    /// Opens a node with its parameters, their services, its clock and its report.
    ///
    /// # Errors
    /// A bad name or parameter, or a refusal of the middleware.
    pub fn node(&mut self, name: &str, parameters: &'static [Spec]) -> Result<Session, ProcessError> {
        let names = self.args.node("/", name)?;
        let table = Arc::new(Parameters::declare(&names.full_name(), &[parameters, COMMON_PARAMETERS]));
        let mut overrides = self.args.overrides(&names);
        for given in &mut overrides {
            given.addressed &= !self.tables.iter().flat_map(|table| table.iter()).any(|spec| spec.name == given.name);
        }
        table.start_with(&overrides)?;
        logging::add_node(name, &names);
        let context = self.context(&table)?;
        let node_name = NodeName::new(names.namespace(), names.name())
            .map_err(|e| SessionError::middleware(format!("node {}", names.full_name()), e))?;
        // Parameters are served from our own table; the library's services know neither ranges nor descriptions.
        let options = NodeOptions::new().start_parameter_services(false).enable_rosout(self.args.rosout);
        let node = context
            .new_node(node_name, options)
            .map_err(|e| SessionError::middleware(format!("node {}", names.full_name()), e))?;
        logging::open_rosout(node.logging_handle());
        let health = Arc::new(Health::new(&names.full_name()));
        let mut session = Session {
            context,
            node: Rc::new(RefCell::new(node)),
            names,
            executor: Rc::clone(&self.executor),
            endpoints: self.endpoints.clone(),
            secured: self.farewell.is_none(),
            parameters: table,
            health,
            clock: Clock::default(),
            activity: Activity::default(),
        };
        services::open(&mut session)?;
        follow_clock(&mut session)?;
        report(&mut session)?;
        Ok(session)
    }

    /// What resolves when a signal has come, for work that has something to bring to its end then: the first signal does
    /// not drop it, and the process waits for it; a second one ends the process as the first one does otherwise.
    pub fn ending(&mut self) -> impl Future<Output = ()> + use<> {
        let (sender, told) = oneshot::channel();
        *self.ending.lock().unwrap_or_else(PoisonError::into_inner) = Some(sender);
        told.map(drop)
    }

    /// Runs the work that `open` makes until it is done, a signal comes or the middleware dies.
    ///
    /// # Errors
    /// What went wrong while opening or running.
    pub fn run(mut self, open: impl FnOnce(&mut Self) -> Result<Work, ProcessError>) -> Result<(), ProcessError> {
        let signalled = self.take_signals()?;
        let rounds = Arc::new(AtomicU64::new(0));
        self.end_when_stalled(Arc::downgrade(&rounds))?;
        let work = open(&mut self)?;
        let participant = self.participant.as_ref().map(|(participant, _)| participant.clone());
        let discovery = discovery::follow(participant, self.endpoints.clone(), self.started_again);
        if let Some(turn) = self.turn.take() {
            let endpoints = self.endpoints.clone();
            self.executor.spawn(turn.done(move || endpoints.handshakes())).detach();
        }
        log::info!("{} is ready", self.name);
        let executor = Rc::clone(&self.executor);
        let result = smol::block_on(executor.run(async {
            futures::select! {
                result = work.fuse() => result,
                _ = signalled.fuse() => Ok(()),
                error = watchdog(&rounds).fuse() => Err(error),
                estranged = Box::pin(discovery).fuse() => Err(estranged.into()),
            }
        }));
        logging::remove_nodes();
        let farewell = self.farewell.take();
        let leave = || {
            if let Some(Err(e)) = farewell.as_ref().map(Farewell::say) {
                log::debug!("nobody was told of the end: {e}");
            }
        };
        if let Err(error @ ProcessError::Deaf(_)) = &result {
            // A dead participant can't be taken down in order; its drop would wait for the dead thread.
            leave();
            std::process::exit(told(self.name, error).into());
        }
        // When nothing of it is left that could announce itself once more.
        let participant = self.participant.take();
        drop((executor, self));
        take_down(participant);
        leave();
        result
    }

    /// Waits for signals, on a thread of its own. What it gives resolves when the process is to end; soon after that it
    /// ends in any case.
    fn take_signals(&self) -> Result<oneshot::Receiver<()>, ProcessError> {
        let (signal, signalled) = oneshot::channel();
        let ending = Arc::clone(&self.ending);
        start_thread("signals", move || {
            loop {
                let Ok(received) = signals().wait() else { return };
                log::info!("{received}: ending");
                let told = ending.lock().unwrap_or_else(PoisonError::into_inner).take();
                if told.is_none_or(|ending| ending.send(()).is_err()) {
                    break;
                }
            }
            let _ = signal.send(());
            std::thread::sleep(END_PATIENCE);
            std::process::exit(0);
        })?;
        Ok(signalled)
    }

    /// Ends the process where its loop, whose rounds are counted, stands still.
    fn end_when_stalled(&self, rounds: Weak<AtomicU64>) -> Result<(), ProcessError> {
        let name = self.name;
        start_thread("watchdog", move || {
            let (mut last, mut looks) = (0, 0);
            while let Some(rounds) = rounds.upgrade() {
                let now = rounds.load(Ordering::Relaxed);
                looks = if now == last { looks + 1 } else { 0 };
                last = now;
                if looks > LOOKS {
                    std::process::exit(told(name, &ProcessError::Stalled).into());
                }
                drop(rounds);
                std::thread::sleep(WATCH_PERIOD);
            }
        })
    }

    /// The DDS participant, which all nodes of the process share; opened with the parameters of the first of them.
    fn context(&mut self, parameters: &Parameters) -> Result<Context, ProcessError> {
        if let Some((_, context)) = &self.participant {
            return Ok(context.clone());
        }
        limit_memory(parameters)?;
        let domain = domain_id(std::env::var("ROS_DOMAIN_ID").ok().as_deref())?;
        let mut builder = DomainParticipantBuilder::new(domain);
        let addresses = interfaces(parameters, |variable| std::env::var(variable).ok())?;
        if !addresses.is_empty() {
            log::debug!("network interfaces: {addresses:?}");
            builder = builder.with_only_networks(addresses.iter().copied());
        }
        let enclave = security::enclave(self.args.enclave.as_deref(), |variable| std::env::var(variable).ok())?;
        let is_secured = enclave.is_some();
        if let Some(enclave) = enclave {
            builder = secured(builder, &enclave);
        }
        let peers = static_peers(parameters, std::env::var("ROS_STATIC_PEERS").ok())?;
        let system = |e: std::io::Error| ProcessError::System { what: "listening to discovery", reason: e.to_string() };
        // Opened before the participant, so that its first announcement is heard.
        let courier =
            if peers.is_empty() { None } else { Some(peers::Courier::open(domain, &addresses).map_err(system)?) };
        self.turn = Some(Turn::take(domain, is_secured));
        let participant = builder.build().map_err(|e| SessionError::middleware(format!("DDS domain {domain}"), e))?;
        if let Some(courier) = courier {
            log::debug!("static peers: {peers:?}");
            courier.serve(participant.guid(), peers.clone()).map_err(system)?;
        }
        self.farewell = (!is_secured).then(|| Farewell::of(participant.guid(), domain, addresses, peers));
        let context = Context::from_domain_participant(participant.clone())
            .map_err(|e| SessionError::middleware(format!("DDS domain {domain}"), e))?;
        self.participant = Some((participant, context.clone()));
        Ok(context)
    }
}

fn signals() -> SigSet {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGINT);
    signals.add(Signal::SIGTERM);
    signals
}

/// The participant's builder with the files of an enclave.
#[cfg(feature = "security")]
fn secured(builder: DomainParticipantBuilder, enclave: &Path) -> DomainParticipantBuilder {
    use rustdds::DomainParticipantSecurityConfigFiles as Files;
    log::info!("secured by the enclave {}", enclave.display());
    // The keys of SROS2 have no password.
    builder.builtin_security(Files::with_ros_default_names(enclave, String::new()))
}

/// Without the feature there is never an enclave.
#[cfg(not(feature = "security"))]
fn secured(builder: DomainParticipantBuilder, _: &Path) -> DomainParticipantBuilder {
    builder
}

/// Sets the limit of the address space, unless a lower one is in force.
fn limit_memory(parameters: &Parameters) -> Result<(), ProcessError> {
    let failed = |e: nix::Error| ProcessError::System { what: "limiting the memory", reason: e.to_string() };
    let Some(limit) = u64::try_from(parameters.integer(&MAXIMUM_MEMORY)).ok().filter(|&mebibytes| mebibytes > 0) else {
        return Ok(());
    };
    let (_, hard) = getrlimit(Resource::RLIMIT_AS).map_err(failed)?;
    setrlimit(Resource::RLIMIT_AS, (limit << 20).min(hard), hard).map_err(failed)
}

/// The addresses that the parameter or the environment restricts the middleware to; none for no restriction.
fn interfaces(
    parameters: &Parameters,
    environment: impl Fn(&'static str) -> Option<String>,
) -> Result<Vec<IpAddr>, ArgsError> {
    let loopback = vec![IpAddr::from([127, 0, 0, 1])];
    let given: Vec<IpAddr> =
        parameters.texts(&NETWORK_INTERFACES).iter().filter_map(|text| text.parse().ok()).collect();
    if !given.is_empty() {
        return Ok(given);
    }
    if environment("ROS_LOCALHOST_ONLY").as_deref() == Some("1") {
        return Ok(loopback);
    }
    match environment("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
        None | Some("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(Vec::new()),
        Some("LOCALHOST" | "OFF") => Ok(loopback),
        Some(other) => Err(ArgsError::Environment {
            variable: "ROS_AUTOMATIC_DISCOVERY_RANGE",
            value: other.to_owned(),
            rule: "must be one of SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT",
        }),
    }
}

/// The hosts to announce this process to, of the parameter or the environment.
fn static_peers(parameters: &Parameters, environment: Option<String>) -> Result<Vec<Ipv4Addr>, ArgsError> {
    let given: Vec<Ipv4Addr> = parameters.texts(&STATIC_PEERS).iter().filter_map(|text| text.parse().ok()).collect();
    if !given.is_empty() {
        return Ok(given);
    }
    let texts = environment.unwrap_or_default();
    let texts = texts.split(';').map(str::trim).filter(|text| !text.is_empty());
    texts
        .map(|text| {
            text.parse().map_err(|_| ArgsError::Environment {
                variable: "ROS_STATIC_PEERS",
                value: text.to_owned(),
                rule: "must be IPv4 addresses, separated by ';'",
            })
        })
        .collect()
}

/// Keeps the session's clock at `/clock` while `use_sim_time` is set.
fn follow_clock(session: &mut Session) -> Result<(), SessionError> {
    let mut ticks = session.subscribe(&topics::CLOCK)?;
    const NANOS: u32 = 1_000_000_000;
    let (clock, parameters) = (session.clock.clone(), Arc::clone(&session.parameters));
    let health = Arc::clone(&session.health);
    let mut changes = parameters.changes();
    let simulated = parameters.bool(&USE_SIM_TIME);
    clock.set(simulated.then(Default::default));
    session.spawn(async move {
        loop {
            futures::select! {
                tick = ticks.next() => match tick {
                    Some(tick) if tick.clock.sec < 0 || tick.clock.nanosec >= NANOS => {
                        let Time { sec, nanosec } = tick.clock;
                        health.refuse("clock", &format!(
                            "/clock: {sec} s and {nanosec} ns: must be 0 s or more, and less than {NANOS} ns"
                        ));
                    }
                    Some(tick) if parameters.bool(&USE_SIM_TIME) => clock.set(Some(tick.clock)),
                    Some(_) => {}
                    None => break,
                },
                change = changes.next() => match (change, parameters.bool(&USE_SIM_TIME)) {
                    (None, _) => break,
                    (Some(()), false) => clock.set(None),
                    (Some(()), true) => clock.begin_simulation(),
                },
            }
        }
    });
    Ok(())
}

/// Publishes the session's report.
fn report(session: &mut Session) -> Result<(), SessionError> {
    let (mut diagnostics, _) = session.publish(&topics::DIAGNOSTICS)?;
    let (health, clock) = (Arc::clone(&session.health), session.clock.clone());
    session.spawn(async move {
        let mut ticks = smol::Timer::interval(REPORT_PERIOD);
        while ticks.next().await.is_some() {
            let header = Header { stamp: clock.now(), frame_id: String::new() };
            if diagnostics.send(DiagnosticArray { header, status: vec![health.report()] }).await.is_err() {
                break;
            }
        }
    });
    Ok(())
}

fn start_thread(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), ProcessError> {
    let started = std::thread::Builder::new().name(name.to_owned()).spawn(work);
    started.map(drop).map_err(|e| ProcessError::System { what: "starting a thread", reason: e.to_string() })
}

/// Drops the participant and so ends its threads; waits for them, but not without limit.
fn take_down(participant: Option<(DomainParticipant, Context)>) {
    let (gone, ended) = mpsc::channel::<()>();
    let dropping = start_thread("take down", move || drop((participant, gone)));
    if dropping.is_ok() && ended.recv_timeout(MIDDLEWARE_PATIENCE) == Err(RecvTimeoutError::Timeout) {
        log::warn!("the middleware has not ended after {} s and is left to itself", MIDDLEWARE_PATIENCE.as_secs());
    }
}

/// Counts the rounds of the process's loop; resolves when a thread of the middleware has ended.
async fn watchdog(rounds: &AtomicU64) -> ProcessError {
    let mut known = middleware_threads();
    loop {
        smol::Timer::after(WATCH_PERIOD).await;
        rounds.fetch_add(1, Ordering::Relaxed);
        let alive = middleware_threads();
        if let Some((_, name)) = known.iter().find(|thread| !alive.contains(thread)) {
            return ProcessError::Deaf(name.clone());
        }
        known = alive;
    }
}

/// Number and name of the threads of the middleware in this process; empty where the system doesn't tell.
fn middleware_threads() -> Vec<(String, String)> {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return Vec::new() };
    tasks
        .flatten()
        .filter_map(|task| {
            let name = std::fs::read_to_string(task.path().join("comm")).ok()?;
            let number = task.file_name().to_string_lossy().into_owned();
            name.starts_with(MIDDLEWARE_THREADS).then(|| (number, name.trim_end().to_owned()))
        })
        .collect()
}

//! One process: command line, signals, participant, nodes, watchdogs, end.
//!
//! **Signals** are blocked on every thread, and one thread waits for them. A handler that ran on one of RustDDS's own
//! threads would interrupt its poll, after which that thread ends for good and the node lives on deaf.
//!
//! A process ends when its work is done, at a signal, and where it is to be [started again](super::exit).

use std::cell::RefCell;
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use futures::channel::oneshot;
use futures::future::LocalBoxFuture;
use futures::{FutureExt, SinkExt, StreamExt};
use jigsaw_msgs::diagnostic_msgs::msg::DiagnosticArray;
use jigsaw_msgs::std_msgs::msg::Header;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::{SigSet, Signal};
use ros2_client::{Context, NodeName, NodeOptions};

use super::activity::Activity;
use super::arguments::RosArgs;
use super::clock::Clock;
use super::discovery::{self, Endpoints};
use super::exit::{ProcessError, exit_code, told};
use super::health::Health;
use super::node_params::{COMMON_PARAMETERS, MAXIMUM_MEMORY};
use super::params::{Parameters, Spec};
use super::participant::Participant;
use super::session::{Session, SessionError};
use super::{logging, services, topics, watchdog};
use crate::console::say;

/// How often a node reports.
const REPORT_PERIOD: Duration = Duration::from_secs(1);

/// How long an ordered end may take after a signal; then the process ends anyway, so that whoever sent the signal
/// need not kill it.
const END_PATIENCE: Duration = Duration::from_millis(800);

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
    /// Which all nodes share; opened with the first of them.
    participant: Option<Participant>,
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
        let (context, secured) = self.context(&table)?;
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
            secured,
            parameters: table,
            health,
            clock: Clock::default(),
            activity: Activity::default(),
        };
        services::open(&mut session)?;
        let ticks = session.subscribe(&topics::CLOCK)?;
        let Session { parameters, health, clock, .. } = &session;
        session.spawn(clock.clone().follow(ticks, Arc::clone(parameters), Arc::clone(health)));
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
        let participant = self.participant.as_ref().map(|joined| joined.participant.clone());
        let discovery = discovery::follow(participant, self.endpoints.clone(), self.started_again);
        if let Some(participant) = &mut self.participant {
            self.executor.spawn(participant.let_others_join(self.endpoints.clone())).detach();
        }
        log::info!("{} is ready", self.name);
        let executor = Rc::clone(&self.executor);
        let result = smol::block_on(executor.run(async {
            futures::select! {
                result = work.fuse() => result,
                _ = signalled.fuse() => Ok(()),
                thread = watchdog::ended_thread(&rounds).fuse() => Err(ProcessError::Deaf(thread)),
                estranged = Box::pin(discovery).fuse() => Err(estranged.into()),
            }
        }));
        logging::remove_nodes();
        let participant = self.participant.take();
        if let Err(error @ ProcessError::Deaf(_)) = &result {
            participant.iter().for_each(Participant::leave_as_it_is);
            std::process::exit(told(self.name, error).into());
        }
        drop((executor, self));
        if let Some(participant) = participant {
            participant.leave();
        }
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
            if watchdog::stands_still(&rounds, || std::thread::sleep(watchdog::PERIOD)) {
                std::process::exit(told(name, &ProcessError::Stalled).into());
            }
        })
    }

    /// The client library's view of the participant, and whether what it sends is encrypted. It is opened with the parameters of
    /// the first node.
    fn context(&mut self, parameters: &Parameters) -> Result<(Context, bool), ProcessError> {
        let joined = match self.participant.take() {
            Some(joined) => joined,
            None => {
                limit_memory(parameters)?;
                Participant::join(parameters, self.args.enclave.as_deref())?
            }
        };
        let joined = self.participant.insert(joined);
        Ok((joined.context.clone(), joined.secured))
    }
}

fn signals() -> SigSet {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGINT);
    signals.add(Signal::SIGTERM);
    signals
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

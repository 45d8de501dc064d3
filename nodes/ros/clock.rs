//! What time it is for a node: the system's, or that of `/clock`.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;

use futures::StreamExt;
use futures::channel::mpsc;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::rosgraph_msgs::msg::Clock as Tick;

use super::health::Health;
use super::node_params::USE_SIM_TIME;
use super::params::Parameters;

/// What time it is: that of the system, or the last of `/clock` under `use_sim_time`.
#[derive(Debug, Clone, Default)]
pub struct Clock {
    simulated: Rc<RefCell<Option<Time>>>,
}

impl Clock {
    /// The time now. Zero under `use_sim_time` until `/clock` was heard, as in ROS.
    pub fn now(&self) -> Time {
        const NANOS: i64 = 1_000_000_000;
        if let Some(time) = self.simulated.borrow().as_ref() {
            return time.clone();
        }
        let nanos = ros2_client::builtin_interfaces::Time::now().to_nanos();
        Time {
            sec: i32::try_from(nanos.div_euclid(NANOS)).unwrap_or(i32::MAX),
            nanosec: u32::try_from(nanos.rem_euclid(NANOS)).unwrap_or_default(),
        }
    }

    fn set(&self, time: Option<Time>) {
        *self.simulated.borrow_mut() = time;
    }

    /// Goes over to simulated time, unless it has it already.
    fn begin_simulation(&self) {
        self.simulated.borrow_mut().get_or_insert_default();
    }

    /// Keeps this clock at the ticks of `/clock` while `use_sim_time` is set: from now on, and while it is awaited.
    pub(super) fn follow(
        self,
        mut ticks: mpsc::Receiver<Tick>,
        parameters: Arc<Parameters>,
        health: Arc<Health>,
    ) -> impl Future<Output = ()> {
        const NANOS: u32 = 1_000_000_000;
        let mut changes = parameters.changes();
        self.set(parameters.bool(&USE_SIM_TIME).then(Default::default));
        async move {
            loop {
                futures::select! {
                    tick = ticks.next() => match tick {
                        Some(tick) if tick.clock.sec < 0 || tick.clock.nanosec >= NANOS => {
                            let Time { sec, nanosec } = tick.clock;
                            health.refuse("clock", &format!(
                                "/clock: {sec} s and {nanosec} ns: must be 0 s or more, and less than {NANOS} ns"
                            ));
                        }
                        Some(tick) if parameters.bool(&USE_SIM_TIME) => self.set(Some(tick.clock)),
                        Some(_) => {}
                        None => break,
                    },
                    change = changes.next() => match (change, parameters.bool(&USE_SIM_TIME)) {
                        (None, _) => break,
                        (Some(()), false) => self.set(None),
                        (Some(()), true) => self.begin_simulation(),
                    },
                }
            }
        }
    }
}

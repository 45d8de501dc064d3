//! The six parameter services of `rcl_interfaces`, over the table of a node. The client library has them too, but
//! knows neither descriptions nor ranges.

use std::rc::Rc;
use std::sync::Arc;

use futures::StreamExt;
use ros2_client::parameters::raw;
use ros2_client::rcl_interfaces::{
    DescribeParametersRequest, DescribeParametersResponse, GetParameterTypesRequest, GetParameterTypesResponse,
    GetParametersRequest, GetParametersResponse, ListParametersRequest, ListParametersResponse, ListParametersResult,
    SetParametersAtomicallyResponse, SetParametersRequest, SetParametersResponse,
};
use ros2_client::{Message, ParameterValue, Publisher, builtin_interfaces};

use super::clock::Clock;
use super::health::Health;
use super::params::Parameters;
use super::session::{Session, SessionError};

/// Opens the services of a node's parameters.
pub(super) fn open(session: &mut Session) -> Result<(), SessionError> {
    let events = session
        .node
        .borrow_mut()
        .create_publisher::<raw::ParameterEvent>(&session.context.get_parameter_events_topic(), None)
        .map_err(|e| SessionError::middleware("publisher of /parameter_events", e))?;
    let changes = Rc::new(Changes { events, health: Arc::clone(&session.health), clock: session.clock.clone() });
    changes.tell(&session.parameters, |event, values| event.new_parameters = values, session.parameters.all());
    serve(session, "GetParameters", "get_parameters", get)?;
    serve(session, "GetParameterTypes", "get_parameter_types", get_types)?;
    serve(session, "ListParameters", "list_parameters", list)?;
    serve(session, "DescribeParameters", "describe_parameters", describe)?;
    let one_by_one = Rc::clone(&changes);
    serve(session, "SetParameters", "set_parameters", move |parameters, request: SetParametersRequest| {
        let results = request.parameter.into_iter().map(|one| one_by_one.set(parameters, vec![one])).collect();
        SetParametersResponse { results }
    })?;
    serve(session, "SetParametersAtomically", "set_parameters_atomically", move |parameters, request| {
        let request: SetParametersRequest = request;
        SetParametersAtomicallyResponse { result: changes.set(parameters, request.parameter) }
    })
}

fn serve<Req: Message + 'static, Resp: Message + 'static>(
    session: &mut Session,
    service_type: &str,
    name: &str,
    answer: impl Fn(&Parameters, Req) -> Resp + 'static,
) -> Result<(), SessionError> {
    let name = session.names.service(&format!("~/{name}"))?;
    let types = ["Request", "Response"].map(|end| format!("rcl_interfaces::srv::dds_::{service_type}_{end}_"));
    let mut calls = session.open_server(&name, types, |request: Req, reply| (request, reply))?;
    let parameters = Arc::clone(&session.parameters);
    session.spawn(async move {
        while let Some((request, reply)) = calls.next().await {
            // A caller that has gone is no concern of the node.
            let _ = reply.send(answer(&parameters, request));
        }
    });
    Ok(())
}

fn get(parameters: &Parameters, request: GetParametersRequest) -> GetParametersResponse {
    let value = |name: &String| parameters.get(name).unwrap_or(ParameterValue::NotSet).into();
    GetParametersResponse { values: request.names.iter().map(value).collect() }
}

fn get_types(parameters: &Parameters, request: GetParameterTypesRequest) -> GetParameterTypesResponse {
    let kind =
        |name: &String| ParameterValue::to_parameter_type_raw(&parameters.get(name).unwrap_or(ParameterValue::NotSet));
    GetParameterTypesResponse { values: request.names.iter().map(kind).collect() }
}

fn describe(parameters: &Parameters, request: DescribeParametersRequest) -> DescribeParametersResponse {
    let unknown = |name: &str| raw::ParameterDescriptor {
        name: name.to_owned(),
        r#type: raw::ParameterType::NOT_SET,
        description: String::new(),
        additional_constraints: String::new(),
        read_only: false,
        dynamic_typing: false,
        floating_point_range: Vec::new(),
        integer_range: Vec::new(),
    };
    let descriptor =
        |name: &String| parameters.spec(name).map_or_else(|| unknown(name), super::params::Spec::descriptor);
    DescribeParametersResponse { values: request.names.iter().map(descriptor).collect() }
}

/// No parameter has a `.` in its name, so that depth never cuts one off: those that equal a prefix, or all.
fn list(parameters: &Parameters, request: ListParametersRequest) -> ListParametersResponse {
    let names = parameters
        .specs()
        .iter()
        .filter(|spec| request.prefixes.is_empty() || request.prefixes.iter().any(|prefix| prefix == spec.name))
        .map(|spec| spec.name.to_owned())
        .collect();
    ListParametersResponse { result: ListParametersResult { names, prefixes: Vec::new() } }
}

/// Sets parameters, and tells of it.
struct Changes {
    events: Publisher<raw::ParameterEvent>,
    health: Arc<Health>,
    clock: Clock,
}

impl Changes {
    fn set(&self, parameters: &Parameters, changes: Vec<raw::Parameter>) -> raw::SetParametersResult {
        let changes: Vec<(String, ParameterValue)> =
            changes.into_iter().map(|change| (change.name, change.value.into())).collect();
        let borrowed: Vec<(&str, &ParameterValue)> =
            changes.iter().map(|(name, value)| (name.as_str(), value)).collect();
        match parameters.set_all(&borrowed) {
            Ok(()) => {
                self.tell(parameters, |event, values| event.changed_parameters = values, changes);
                raw::SetParametersResult { successful: true, reason: String::new() }
            }
            Err(refusal) => {
                self.health.refuse("parameter", &refusal.to_string());
                raw::SetParametersResult { successful: false, reason: refusal.to_string() }
            }
        }
    }

    fn tell(
        &self,
        parameters: &Parameters,
        place: impl FnOnce(&mut raw::ParameterEvent, Vec<raw::Parameter>),
        values: Vec<(String, ParameterValue)>,
    ) {
        let now = self.clock.now();
        let nanosec = i64::from(now.sec) * 1_000_000_000 + i64::from(now.nanosec);
        let mut event = raw::ParameterEvent {
            stamp: builtin_interfaces::Time::from_nanos(nanosec),
            node: parameters.node().to_owned(),
            new_parameters: Vec::new(),
            changed_parameters: Vec::new(),
            deleted_parameters: Vec::new(),
        };
        let values = values.into_iter().map(|(name, value)| raw::Parameter { name, value: value.into() }).collect();
        place(&mut event, values);
        if self.events.publish(event).is_err() {
            self.health.warn("write", "a change of parameters was not written on /parameter_events");
        }
    }
}

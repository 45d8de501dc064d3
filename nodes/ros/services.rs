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
use ros2_client::{Message, ParameterValue, Publisher, ServiceMapping, ServiceTypeName, builtin_interfaces};

use super::params::Parameters;
use super::session::{Session, SessionError, dds_name};
use super::topics::SERVICE_QOS;

/// Opens the services of a node's parameters.
pub(super) fn open(session: &mut Session) -> Result<(), SessionError> {
    let events = session
        .node
        .create_publisher::<raw::ParameterEvent>(&session.context.get_parameter_events_topic(), None)
        .map_err(|e| SessionError::middleware("publisher of /parameter_events", e))?;
    let events = &Rc::new(events);
    serve(session, "GetParameters", "get_parameters", get)?;
    serve(session, "GetParameterTypes", "get_parameter_types", get_types)?;
    serve(session, "ListParameters", "list_parameters", list)?;
    serve(session, "DescribeParameters", "describe_parameters", describe)?;
    let publisher = Rc::clone(events);
    serve(session, "SetParameters", "set_parameters", move |parameters, request: SetParametersRequest| {
        let results = request.parameter.into_iter().map(|one| set(parameters, &publisher, vec![one])).collect();
        SetParametersResponse { results }
    })?;
    let publisher = Rc::clone(events);
    serve(session, "SetParametersAtomically", "set_parameters_atomically", move |parameters, request| {
        let request: SetParametersRequest = request;
        SetParametersAtomicallyResponse { result: set(parameters, &publisher, request.parameter) }
    })
}

fn serve<Req: Message + Clone + 'static, Resp: Message + 'static>(
    session: &mut Session,
    service_type: &str,
    name: &str,
    answer: impl Fn(&Parameters, Req) -> Resp + 'static,
) -> Result<(), SessionError> {
    let name = session.names.service(&format!("~/{name}"))?;
    let server = session
        .node
        .create_server::<Req, Resp>(
            ServiceMapping::Enhanced,
            &dds_name(&name)?,
            &ServiceTypeName::new("rcl_interfaces", service_type),
            SERVICE_QOS,
            SERVICE_QOS,
        )
        .map_err(|e| SessionError::middleware(format!("service {name}"), e))?;
    let (parameters, health) = (Arc::clone(&session.parameters), Arc::clone(&session.health));
    session.spawn(async move {
        let mut requests = server.receive_request_stream();
        while let Some(request) = requests.next().await {
            match request {
                Ok((id, request)) => {
                    if let Err(e) = server.async_send_response(id, answer(&parameters, request)).await {
                        health.warn("write", &format!("the answer of {name} was not written: {e}"));
                    }
                }
                Err(e) => health.refuse("undecodable", &format!("request of {name} can't be decoded: {e}")),
            }
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

fn set(
    parameters: &Parameters,
    events: &Publisher<raw::ParameterEvent>,
    changes: Vec<raw::Parameter>,
) -> raw::SetParametersResult {
    let changes: Vec<(String, ParameterValue)> =
        changes.into_iter().map(|change| (change.name, change.value.into())).collect();
    let borrowed: Vec<(&str, &ParameterValue)> = changes.iter().map(|(name, value)| (name.as_str(), value)).collect();
    match parameters.set_all(&borrowed) {
        Ok(()) => {
            report(parameters, events, changes);
            raw::SetParametersResult { successful: true, reason: String::new() }
        }
        Err(refusal) => {
            log::warn!("{refusal}");
            raw::SetParametersResult { successful: false, reason: refusal.to_string() }
        }
    }
}

fn report(parameters: &Parameters, events: &Publisher<raw::ParameterEvent>, changes: Vec<(String, ParameterValue)>) {
    let changed_parameters =
        changes.into_iter().map(|(name, value)| raw::Parameter { name, value: value.into() }).collect();
    let event = raw::ParameterEvent {
        stamp: builtin_interfaces::Time::now(),
        node: parameters.node().to_owned(),
        new_parameters: Vec::new(),
        changed_parameters,
        deleted_parameters: Vec::new(),
    };
    if events.publish(event).is_err() {
        log::warn!("the change of a parameter could not be published on /parameter_events");
    }
}

//! The types as CDR, the form in which DDS and bags carry them.

#![allow(clippy::unwrap_used)] // also in what the tests share

use std::fmt::Debug;

use byteorder::LittleEndian;
use jigsaw_msgs::builtin_interfaces::msg::{Duration, Time};
use jigsaw_msgs::geometry_msgs::msg::{Point32, Pose, Quaternion};
use jigsaw_msgs::msg::{Assembly, Isthmus, Mating};
use jigsaw_msgs::rcl_interfaces::msg::{IntegerRange, ParameterDescriptor};
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::Header;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerRequest, TriggerResponse};
use jigsaw_msgs::unique_identifier_msgs::msg::UUID;
use jigsaw_msgs::{
    Action, MESSAGE_TYPES, Message, Service, Visitor,
    action::{Assemble, AssembleGoal},
    visit,
};

fn encode<M: Message>(message: &M) -> Vec<u8> {
    cdr_encoding::to_vec::<M, LittleEndian>(message).unwrap()
}

fn assert_golden<M: Message + Debug>(message: &M, golden: &[&[u8]]) {
    let golden = golden.concat();
    assert_eq!(encode(message), golden);
    let (decoded, length) = cdr_encoding::from_bytes::<M, LittleEndian>(&golden).unwrap();
    assert_eq!(&decoded, message);
    assert_eq!(length, golden.len());
}

fn header() -> Header {
    Header { stamp: Time { sec: -1, nanosec: 5 }, frame_id: "cam".to_owned() }
}

const HEADER: &[u8] = &[0xff, 0xff, 0xff, 0xff, 5, 0, 0, 0, 4, 0, 0, 0, b'c', b'a', b'm', 0];

#[test]
fn image_bytes() {
    let image = Image {
        header: header(),
        height: 1,
        width: 3,
        encoding: "mono8".to_owned(),
        is_bigendian: 0,
        step: 3,
        data: vec![7, 8, 9],
    };
    assert_golden(
        &image,
        &[
            HEADER,
            &[1, 0, 0, 0, 3, 0, 0, 0],
            &[6, 0, 0, 0, b'm', b'o', b'n', b'o', b'8', 0],
            &[0, 0], // is_bigendian, and one byte so that step starts at a multiple of 4
            &[3, 0, 0, 0],
            &[3, 0, 0, 0, 7, 8, 9],
        ],
    );
}

#[test]
fn fixed_arrays_have_no_length_and_sequences_do() {
    let isthmus = Isthmus {
        polarity: Isthmus::NEGATIVE,
        salient: true,
        point_px: Point32 { x: 1.0, y: 2.0, z: 0.0 },
        critical_points_px: [Point32 { x: 0.5, ..Point32::default() }, Point32::default()],
        arc_px: [1.0, 2.0],
        width_px: 1.0,
        path_length_px: 1.0,
        persistence_px: 1.0,
        idf_px: vec![2.0],
    };
    let one = &1.0f32.to_le_bytes();
    let two = &2.0f32.to_le_bytes();
    let half = &0.5f32.to_le_bytes();
    let zero = &[0; 4];
    assert_golden(
        &isthmus,
        &[
            &[1, 1, 0, 0],
            one,
            two,
            zero,
            half,
            zero,
            zero,
            zero,
            zero,
            zero,
            one,
            two,
            one,
            one,
            one,
            &[1, 0, 0, 0],
            two,
        ],
    );
    let id = UUID { uuid: std::array::from_fn(|index| index as u8) };
    assert_golden(&id, &[&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]]);
}

#[test]
fn an_empty_structure_is_one_byte() {
    assert_golden(&TriggerRequest::default(), &[&[0]]);
    let done = TriggerResponse { success: true, message: String::new() };
    assert_golden(&done, &[&[1, 0, 0, 0], &[1, 0, 0, 0, 0]]);
}

#[test]
fn defaults_are_those_of_the_definition() {
    assert_eq!(Pose::default().orientation, Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    assert_eq!(Assembly::default().state, Assembly::COLLECTING);
}

#[test]
fn a_bound_is_kept_in_both_directions() {
    let ranges = |count| vec![IntegerRange::default(); count];
    let at_bound = ParameterDescriptor { integer_range: ranges(1), ..ParameterDescriptor::default() };
    let mut bytes = encode(&at_bound);
    assert_eq!(cdr_encoding::from_bytes::<ParameterDescriptor, LittleEndian>(&bytes).unwrap().0, at_bound);

    let over = ParameterDescriptor { integer_range: ranges(2), ..ParameterDescriptor::default() };
    let error = cdr_encoding::to_vec::<_, LittleEndian>(&over).unwrap_err().to_string();
    assert!(error.contains("length 2 is over the bound of 1"), "{error}");

    // The last sequence has one element, which is all zeros.
    let count = bytes.windows(4).rposition(|window| window == [1, 0, 0, 0]).unwrap();
    bytes[count] = 2;
    bytes.extend([0; 24]);
    let error = cdr_encoding::from_bytes::<ParameterDescriptor, LittleEndian>(&bytes).unwrap_err().to_string();
    assert!(error.contains("length 2 is over the bound of 1"), "{error}");
}

/// Decodes a prefix of the default's bytes; tells whether all of them came back and every shorter prefix was refused.
struct RoundTrip;

impl Visitor for RoundTrip {
    type Output = Result<(), String>;
    fn visit<M: Message>(self) -> Self::Output {
        let bytes = encode(&M::default());
        match cdr_encoding::from_bytes::<M, LittleEndian>(&bytes) {
            Ok((decoded, length)) if decoded == M::default() && length == bytes.len() => {}
            other => return Err(format!("whole: {other:?}")),
        }
        for length in 0..bytes.len() {
            if let Ok(decoded) = cdr_encoding::from_bytes::<M, LittleEndian>(&bytes[..length]) {
                return Err(format!("cut to {length} of {} bytes gave {decoded:?}", bytes.len()));
            }
        }
        Ok(())
    }
}

#[test]
fn every_type_comes_back_whole_and_is_refused_when_cut() {
    for known in MESSAGE_TYPES {
        assert_eq!(visit(known.full_name, RoundTrip), Some(Ok(())), "{}", known.full_name);
    }
}

#[test]
fn services_and_actions_name_their_parts() {
    fn names<S: Service>() -> (String, &'static str, &'static str) {
        (format!("{}/srv/{}", S::PACKAGE, S::NAME), S::Request::TYPE.full_name, S::Response::TYPE.dds_name)
    }
    let expected = ("std_srvs/srv/Trigger", "std_srvs/srv/Trigger_Request", "std_srvs::srv::dds_::Trigger_Response_");
    assert_eq!(names::<Trigger>(), (expected.0.to_owned(), expected.1, expected.2));

    let goal = AssembleGoal { expected_pieces: 24, time_budget: Duration { sec: 1, nanosec: 0 } };
    assert_golden(&goal, &[&[24, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]]);
    assert_eq!(<Assemble as Action>::Feedback::TYPE.full_name, "jigsaw_msgs/action/Assemble_Feedback");
}

#[test]
fn a_mating_is_aligned_after_each_string() {
    let mating = Mating {
        positive_piece: "a".to_owned(),
        positive_isthmus: 1,
        negative_piece: "bcd".to_owned(),
        negative_isthmus: 2,
        correlation: 1.0,
        ave_gap: 0.5,
        clearance: -0.5,
        confidence: 1.0,
    };
    let floats: Vec<u8> = [1.0f32, 0.5, -0.5, 1.0].iter().flat_map(|value| value.to_le_bytes()).collect();
    assert_golden(
        &mating,
        &[&[2, 0, 0, 0, b'a', 0, 0, 0], &[1, 0, 0, 0], &[4, 0, 0, 0, b'b', b'c', b'd', 0], &[2, 0, 0, 0], &floats],
    );
}

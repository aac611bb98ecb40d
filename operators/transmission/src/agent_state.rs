//! An agent's pose and motion as bytes.

use realo_schemas::{AgentState, PoseStatus};

use crate::bytes::{Reader, put_covariance6, put_f64s, put_pose};
use crate::error::{DecodeError, EncodeError};

const COVARIANCE: u8 = 1;
const VELOCITY: u8 = 2;
const RATE: u8 = 4;

pub(crate) fn write(out: &mut Vec<u8>, state: &AgentState) -> Result<(), EncodeError> {
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    let status = state.status as u8;
    let flags = flag(state.covariance.is_some(), COVARIANCE)
        | flag(state.velocity.is_some(), VELOCITY)
        | flag(state.angular_rate.is_some(), RATE);
    out.extend([flags, status]);
    put_pose(out, &state.map_from_body, "map_from_body")?;
    if let Some(covariance) = &state.covariance {
        put_covariance6(out, covariance, "covariance")?;
    }
    if let Some(velocity) = &state.velocity {
        put_f64s(out, velocity.as_slice(), "velocity")?;
    }
    if let Some(rate) = &state.angular_rate {
        put_f64s(out, rate.as_slice(), "angular rate")?;
    }
    Ok(())
}

pub(crate) fn read(bytes: &mut Reader) -> Result<AgentState, DecodeError> {
    let flags = bytes.flags(COVARIANCE | VELOCITY | RATE, "flags of the state")?;
    let code = bytes.u8("status")?;
    let unknown = || DecodeError::Value {
        field: "status",
        expected: "0 to 6",
        found: code.to_string(),
    };
    let status = *PoseStatus::ALL.get(usize::from(code)).ok_or_else(unknown)?;
    Ok(AgentState {
        map_from_body: bytes.pose("map_from_body")?,
        covariance: if flags & COVARIANCE == 0 {
            None
        } else {
            Some(bytes.covariance6("covariance")?)
        },
        velocity: if flags & VELOCITY == 0 {
            None
        } else {
            Some(bytes.f64s::<3>("velocity")?.into())
        },
        angular_rate: if flags & RATE == 0 {
            None
        } else {
            Some(bytes.f64s::<3>("angular rate")?.into())
        },
        status,
    })
}

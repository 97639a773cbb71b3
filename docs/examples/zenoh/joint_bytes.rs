//! The bytes of docs/wire.md: the attachment, and a sensor_msgs/msg/JointState.

/// Number, time of the sample [ns since 1970], 16, publisher id: 33 bytes, little endian.
pub fn attachment(sequence: i64, source_ns: i64, gid: &[u8; 16]) -> Vec<u8> {
    let mut out = Vec::with_capacity(33);
    out.extend(sequence.to_le_bytes());
    out.extend(source_ns.to_le_bytes());
    out.push(16);
    out.extend(gid);
    out
}

/// Appends a value, aligned to its own size counted behind the 4 bytes of encapsulation.
fn put(out: &mut Vec<u8>, value: &[u8]) {
    while (out.len() - 4) % value.len() != 0 {
        out.push(0);
    }
    out.extend(value);
}

fn put_u32(out: &mut Vec<u8>, value: usize) {
    put(out, &(value as u32).to_le_bytes());
}

/// A string: its length with the zero at its end, then both.
fn put_text(out: &mut Vec<u8>, text: &str) {
    put_u32(out, text.len() + 1);
    out.extend(text.as_bytes());
    out.push(0);
}

/// Three joints; velocity and effort stay empty.
pub fn joint_state(stamp_ns: i64, position_rad: [f64; 3]) -> Vec<u8> {
    let mut out = vec![0, 1, 0, 0]; // CDR, little endian
    put(&mut out, &((stamp_ns / 1_000_000_000) as i32).to_le_bytes());
    put(&mut out, &((stamp_ns % 1_000_000_000) as u32).to_le_bytes());
    put_text(&mut out, "base_link");
    put_u32(&mut out, 3);
    for name in ["shoulder", "elbow", "wrist"] {
        put_text(&mut out, name);
    }
    put_u32(&mut out, position_rad.len());
    for value in position_rad {
        put(&mut out, &value.to_le_bytes());
    }
    put_u32(&mut out, 0);
    put_u32(&mut out, 0);
    out
}

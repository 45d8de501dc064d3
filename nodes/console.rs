//! What a program says on its two streams. Where nobody reads them any more (`… | head`), or their file is full, a line is
//! lost; that is no reason to panic, as `println!` does.

/// A line on the standard output: what was asked for.
macro_rules! say {
    ($($line:tt)*) => {
        std::io::Write::write_fmt(&mut std::io::stdout(), format_args!("{}\n", format_args!($($line)*))).unwrap_or_default()
    };
}

/// A line on the standard error: faults, and what goes on.
macro_rules! complain {
    ($($line:tt)*) => {
        std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("{}\n", format_args!($($line)*))).unwrap_or_default()
    };
}

pub(crate) use {complain, say};

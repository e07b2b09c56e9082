//! The `pantaray` command.

fn main() {}

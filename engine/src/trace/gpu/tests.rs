//! The kernels against their twins and the CPU: text and layout without a device, results on software Vulkan.

use super::shader::{Dialect, Pages};

/// All dialects.
fn dialects() -> Vec<Dialect> {
    let mut all = Vec::new();
    for wide in [false, true] {
        for (has_double, is_exact) in [(false, false), (true, false), (true, true)] {
            all.push(Dialect { wide, has_double, is_exact });
        }
    }
    all
}

fn parsed(source: &str) -> naga::Module {
    naga::front::wgsl::parse_str(source).unwrap_or_else(|error| panic!("{}", error.emit_to_string(source)))
}

/// Catches a shader that some adapter would refuse: every one there is, parsed and validated without a device.
#[test]
fn every_shader_is_valid() {
    use naga::valid::{Capabilities, SubgroupOperationSet, ValidationFlags, Validator};
    for dialect in dialects() {
        let mut capabilities = Capabilities::empty();
        capabilities.set(Capabilities::FLOAT64, dialect.has_double);
        capabilities.set(Capabilities::SUBGROUP, dialect.wide);
        let mut sources = vec![dialect.projection()];
        sources.extend([1, 2, 8].map(|count| dialect.kernel(Pages { count, bytes: 1 << 20 })));
        for source in sources {
            let module = parsed(&source);
            let mut validator = Validator::new(ValidationFlags::all(), capabilities);
            validator.subgroup_stages(naga::valid::ShaderStages::COMPUTE);
            validator.subgroup_operations(SubgroupOperationSet::all());
            if let Err(error) = validator.validate(&module) {
                panic!("{dialect:?}: {}", error.emit_to_string(&source));
            }
        }
    }
}

//! Every WGSL text of the table is valid and is what the table says: parameters, bindings, access, entry point, opening lines.

use naga::back::{hlsl, msl};
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, GlobalVariable, Module, ScalarKind, ShaderStage, StorageAccess, TypeInner};
use srn_shaders::{Binding, COMMON, Cooperative, Element, Kernel, Requirement, Scalar, TABLE, Variant};
use std::collections::BTreeSet;
use std::path::Path;

/// Every variant of every kernel, with its label and parsed module.
fn modules() -> impl Iterator<Item = (String, &'static Kernel, &'static Variant, Module)> {
    TABLE.iter().flat_map(|kernel| {
        kernel.variants.iter().map(move |variant| {
            let label = format!("{}/{}.wgsl", kernel.op, variant.name);
            let source = source(kernel, variant, 16);
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{label}: {}", error.emit_to_string(&source)));
            (label, *kernel, variant, module)
        })
    })
}

/// The whole text, for cooperative matrices of `side` × `side` (most GPUs have 16 × 16) and subgroups of 32.
fn source(kernel: &Kernel, variant: &Variant, side: u32) -> String {
    let cooperative = variant.requires.contains(&Requirement::CooperativeMatrices);
    let head = cooperative.then(|| Cooperative { side, lanes: 32 }.head());
    head.unwrap_or_default() + &kernel.source(variant)
}

fn global<'m>(module: &'m Module, name: &str) -> Option<&'m GlobalVariable> {
    module.global_variables.iter().map(|(_, variable)| variable).find(|variable| variable.name.as_deref() == Some(name))
}

#[test]
fn every_kernel_validates() {
    for (label, kernel, variant, module) in modules() {
        // What asks for no subgroups must do without: browsers have none.
        let capabilities = variant.requires.iter().map(|requirement| match requirement {
            Requirement::Subgroups => Capabilities::SUBGROUP,
            Requirement::CooperativeMatrices => {
                Capabilities::SUBGROUP | Capabilities::SHADER_FLOAT16 | Capabilities::COOPERATIVE_MATRIX
            }
            Requirement::FeaturesMultipleOf4
            | Requirement::FeaturesAtMost64
            | Requirement::FeaturesAtMost256
            | Requirement::FeaturesAtMost1024 => Capabilities::empty(),
        });
        let capabilities = capabilities.fold(Capabilities::empty(), |all, one| all | one);
        if let Err(error) = Validator::new(ValidationFlags::all(), Capabilities::default() | capabilities).validate(&module) {
            panic!("{label}: {}", error.emit_to_string(&source(kernel, variant, 16)));
        }
    }
}

/// On Vulkan they run, in all other tests; here at least the shader texts are written that drivers of other systems get.
#[test]
fn every_kernel_can_be_written_for_metal_and_dx12() {
    for (label, kernel, variant, _) in modules() {
        // Those of Metal.
        let module = naga::front::wgsl::parse_str(&source(kernel, variant, 8)).unwrap();
        let info = Validator::new(ValidationFlags::all(), Capabilities::all()).validate(&module).unwrap();

        let metal = msl::Options { lang_version: (2, 4), fake_missing_bindings: true, ..Default::default() };
        let written = msl::write_string(&module, &info, &metal, &Default::default());
        assert!(written.is_ok(), "{label}: {:?}", written.err());

        // Direct3D has none in compute shaders; without dxcompiler.dll it has shader model 5.1, and no subgroups.
        let shader_model = match variant.requires {
            needs if needs.contains(&Requirement::CooperativeMatrices) => continue,
            needs if needs.contains(&Requirement::Subgroups) => hlsl::ShaderModel::V6_0,
            _ => hlsl::ShaderModel::V5_1,
        };
        let dx12 = hlsl::Options { shader_model, fake_missing_bindings: true, ..Default::default() };
        let (mut text, pipeline) = (String::new(), hlsl::PipelineOptions::default());
        let written = hlsl::Writer::new(&mut text, &dx12, &pipeline).write(&module, &info, None).map(|_| ());
        assert!(written.is_ok(), "{label}: {:?}", written.err());
    }
}

#[test]
fn every_kernel_has_one_entry_point_main() {
    for (label, _, variant, module) in modules() {
        assert_eq!(module.entry_points.len(), 1, "{label}");
        let main = &module.entry_points[0];
        assert_eq!((main.name.as_str(), main.stage), ("main", ShaderStage::Compute), "{label}");
        // Of 32 where an invocation does much: a few hundred rows are then work for more than a few of a device's cores.
        let sizes: &[u32] = if variant.requires.contains(&Requirement::CooperativeMatrices) { &[128] } else { &[32, 64] };
        assert!(sizes.contains(&main.workgroup_size.iter().product::<u32>()), "{label}");
        if sizes == [128] {
            continue; // Its invocations share the tile by subgroups.
        }
        for (tile, size) in variant.tile.iter().zip(main.workgroup_size) {
            // Several to a row, or some rows for each.
            let is_even = tile % size == 0 || size % tile == 0;
            assert!(is_even, "{label}: tile {:?}, workgroup {:?}", variant.tile, main.workgroup_size);
        }
    }
}

#[test]
fn params_have_the_layout_of_the_rust_struct() {
    for (label, kernel, _, module) in modules() {
        let params = global(&module, "params").unwrap_or_else(|| panic!("{label}: no params"));
        assert_eq!(params.space, AddressSpace::Uniform, "{label}");
        assert_eq!(params.binding.map(|b| (b.group, b.binding)), Some((0, 0)), "{label}");
        let ty = &module.types[params.ty];
        assert_eq!(ty.name.as_deref(), Some("Params"), "{label}");
        let TypeInner::Struct { members, span } = &ty.inner else { panic!("{label}: params is no struct") };
        let found: Vec<_> = members
            .iter()
            .map(|member| {
                let scalar = match module.types[member.ty].inner {
                    TypeInner::Scalar(naga::Scalar::U32) => Scalar::U32,
                    TypeInner::Scalar(naga::Scalar::F32) => Scalar::F32,
                    ref other => panic!("{label}: params.{:?} is {other:?}", member.name),
                };
                (member.name.as_deref().unwrap_or(""), scalar, member.offset as usize)
            })
            .collect();
        assert_eq!(found, kernel.params.fields, "{label} against {}", kernel.params.name);
        assert_eq!(*span as usize, kernel.params.size, "{label} against {}", kernel.params.name);
    }
}

/// Checks one storage variable: `array<T>`, or `array<vec4<T>>` where the variant asks for multiples of 4.
fn check_storage(label: &str, module: &Module, number: u32, binding: &Binding, requires: &[Requirement]) {
    let label = format!("{label}: {}", binding.name);
    let variable = global(module, binding.name).unwrap_or_else(|| panic!("{label} is missing"));
    assert_eq!(variable.binding.map(|b| (b.group, b.binding)), Some((0, number)), "{label}");
    let access = if binding.written { StorageAccess::LOAD | StorageAccess::STORE } else { StorageAccess::LOAD };
    assert_eq!(variable.space, AddressSpace::Storage { access }, "{label}");
    let TypeInner::Array { base, size: naga::ArraySize::Dynamic, .. } = module.types[variable.ty].inner else {
        panic!("{label} is no array");
    };
    let vectors = requires.contains(&Requirement::FeaturesMultipleOf4);
    let scalar = match &module.types[base].inner {
        TypeInner::Scalar(scalar) => scalar,
        TypeInner::Vector { size: naga::VectorSize::Quad, scalar } if vectors => scalar,
        other => panic!("{label} has elements {other:?}"),
    };
    let kind = match binding.element {
        Element::F32 => ScalarKind::Float,
        Element::U32 => ScalarKind::Uint,
    };
    assert_eq!((scalar.kind, scalar.width), (kind, 4), "{label}");
}

#[test]
fn bindings_are_those_of_the_table() {
    for (label, kernel, variant, module) in modules() {
        for (number, binding) in (1..).zip(kernel.bindings) {
            check_storage(&label, &module, number, binding, variant.requires);
        }
        let bound = module.global_variables.iter().filter(|(_, variable)| variable.binding.is_some()).count();
        assert_eq!(bound, 1 + kernel.bindings.len(), "{label}: number of bindings");
        assert!(kernel.bindings.len() <= 8, "{label}: more storage buffers than every adapter offers");
    }
}

#[test]
fn opening_lines_say_what_a_kernel_does() {
    for (label, _, variant, _) in modules() {
        let lines: Vec<_> = variant.text.lines().take(5).collect();
        assert!(lines[..4].iter().all(|line| line.starts_with("// ")), "{label}: four comment lines: {lines:?}");
        assert!(lines[0].contains('='), "{label}: the first line is the formula: {}", lines[0]);
        assert!(lines[1].starts_with("// One invocation "), "{label}: {}", lines[1]);
        assert!(lines[2].contains(" → "), "{label}: the third line is the shapes: {}", lines[2]);
        assert!(lines[3].contains("OVERWRITES") || lines[3].contains("ACCUMULATES"), "{label}: {}", lines[3]);
        assert_eq!(lines[4], "", "{label}: four comment lines, not more");
    }
}

#[test]
fn every_wgsl_file_is_in_the_table() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shaders");
    let known: BTreeSet<String> = modules().map(|(label, ..)| label).collect();
    let mut found = BTreeSet::new();
    for op in std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap()).filter(|entry| entry.path().is_dir()) {
        for file in std::fs::read_dir(op.path()).unwrap().map(|entry| entry.unwrap()) {
            let (op, name) = (op.file_name().into_string().unwrap(), file.file_name().into_string().unwrap());
            let text = std::fs::read_to_string(file.path()).unwrap();
            if op == "common" {
                let is_shared = TABLE.iter().any(|kernel| kernel.variants.iter().any(|variant| variant.with.contains(&&*text)));
                assert!(is_shared || COMMON.contains(text.trim_end()), "shaders/common/{name} is in no kernel");
            } else if name.ends_with(".wgsl") {
                found.insert(format!("{op}/{name}"));
            }
        }
    }
    assert_eq!(found, known);
}

//! Point instancers: a scope for each prototype, a use of one for each point.

use std::collections::HashSet;

use glam::{DMat4, DQuat, DVec3};

use super::walk::Walk;
use super::{primvar, value};
use crate::Result;
use crate::import::assembly::Use;

/// Adds the copies of an instancer to the scope that it stands in.
pub(super) fn place(
    walk: &mut Walk<'_>,
    path: &str,
    scope_from_prim: DMat4,
    nesting: usize,
    uses: &mut Vec<Use>,
) -> Result<()> {
    let stage = walk.stage;
    let targets = stage.stage.relationship(format!("{path}.prototypes")).targets();
    let targets = targets.map_err(|error| stage.broken(path, format!("{error:#}")))?;
    let mut scopes = Vec::with_capacity(targets.len());
    for target in &targets {
        let is_there = stage.stage.prim(target.as_str()).is_valid().unwrap_or(false);
        let scope = is_there.then(|| walk.scope(target.as_str(), DMat4::IDENTITY, nesting + 1));
        scopes.push(scope.transpose()?);
    }
    walk.leave_out_primvars(primvar::of_prim(stage, path, &[]).len());
    let indices = stage.integers(path, "protoIndices").unwrap_or_default();
    let positions =
        stage.value(path, "positions").and_then(|value| value::vectors(&value)).unwrap_or_default();
    let rotations = stage.value(path, "orientationsf").and_then(|value| value::rotations(&value));
    let rotations = rotations.filter(|all| !all.is_empty());
    let rotations =
        rotations.or_else(|| stage.value(path, "orientations").and_then(|value| value::rotations(&value)));
    let scales = stage.value(path, "scales").and_then(|value| value::vectors(&value));
    if positions.len() != indices.len() {
        let (count, places) = (indices.len(), positions.len());
        walk.found
            .report
            .warn(format!("`{path}` has {places} positions for {count} copies: the rest is left out"));
    }
    for (name, count) in
        [("orientations", rotations.as_ref().map(Vec::len)), ("scales", scales.as_ref().map(Vec::len))]
    {
        if let Some(count) = count.filter(|&count| count > 0 && count != indices.len()) {
            let expected = indices.len();
            walk.found
                .report
                .warn(format!("`{path}` has {count} {name} for {expected} copies: the rest has none"));
        }
    }
    let mut hidden: HashSet<i64> =
        stage.integers(path, "invisibleIds").unwrap_or_default().into_iter().collect();
    hidden.extend(stage.prim_list(path, "inactiveIds"));
    let ids = stage.integers(path, "ids").filter(|ids| ids.len() == indices.len());
    let mut is_listed = vec![false; scopes.len()];
    for (i, (&index, &position)) in indices.iter().zip(&positions).enumerate() {
        if hidden.contains(&ids.as_ref().map_or(i as i64, |ids| ids[i])) {
            walk.found.report.skip("invisible and inactive copies", 1);
            continue;
        }
        let number = usize::try_from(index).ok();
        let Some((number, scope)) = number.and_then(|number| Some((number, (*scopes.get(number)?)?))) else {
            walk.found.report.skip("copies of a prototype that is not there", 1);
            continue;
        };
        let rotation = rotations.as_ref().and_then(|all| all.get(i)).copied().unwrap_or(DQuat::IDENTITY);
        let scale = scales.as_ref().and_then(|all| all.get(i)).copied().unwrap_or(DVec3::ONE);
        let outer_from_inner =
            scope_from_prim * DMat4::from_scale_rotation_translation(scale, rotation, position);
        let listed = !std::mem::replace(&mut is_listed[number], true);
        walk.place(Use { scope, outer_from_inner, listed, placed: true }, uses);
    }
    Ok(())
}

//! Parts of documents that programs write.

/// `document` with what stands between `<!-- NAME -->` and `<!-- /NAME -->` replaced.
pub fn replace(document: &str, name: &str, text: &str) -> Result<String, String> {
    let (open, close) = (format!("<!-- {name} -->\n"), format!("<!-- /{name} -->"));
    let parts = document.split_once(&open).and_then(|(before, rest)| Some((before, rest.split_once(&close)?.1)));
    let (before, after) = parts.ok_or_else(|| format!("no lines <!-- {name} --> and <!-- /{name} -->"))?;
    Ok(format!("{before}{open}{text}{close}{after}"))
}

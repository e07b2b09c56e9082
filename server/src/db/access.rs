//! Tokens, tickets, projects and the audit. Secrets are kept as SHA-256: they have 160 random bits, so a slow hash would
//! protect nothing more.

use protocol::Role;
use protocol::admin::{AuditEntry, AuditPage, Project, TokenDetail};

use super::{Row, Store};
use crate::error::Kind;
use crate::{Error, Result, values};

/// A token.
#[derive(Clone, Debug)]
pub struct Token {
    /// What is public of it.
    pub detail: TokenDetail,
    /// SHA-256 of its secret, in hexadecimal.
    pub sha256: String,
    /// The only worker that may use it.
    pub worker: Option<String>,
    /// Labels that its worker gets.
    pub labels: Vec<String>,
    /// The token that a browser signed in with, where this is the session of one.
    pub parent: Option<String>,
}

const TOKEN: &str =
    "SELECT id, role, project, label, created_at, expires_at, revoked_at, last_used_at, sha256, worker,
    labels, parent FROM token";

fn token(row: &Row) -> Result<Token> {
    Ok(Token {
        detail: TokenDetail {
            id: row.text(0)?,
            role: row.word(1, Role::from_code)?,
            project: row.text_or_null(2)?,
            label: row.text(3)?,
            created_at: row.int(4)?,
            expires_at: row.int_or_null(5)?,
            revoked_at: row.int_or_null(6)?,
            last_used_at: row.int_or_null(7)?,
        },
        sha256: row.text(8)?,
        worker: row.text_or_null(9)?,
        labels: serde_json::from_str(&row.text(10)?)?,
        parent: row.text_or_null(11)?,
    })
}

impl Store {
    /// Adds a token.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn add_token(&self, token: &Token) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql =
            "INSERT INTO token (id, sha256, role, project, worker, labels, label, created_at, expires_at, parent)
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)";
        let detail = &token.detail;
        let values = values![
            &detail.id,
            &token.sha256,
            detail.role.code(),
            detail.project.clone(),
            token.worker.clone(),
            serde_json::to_string(&token.labels)?,
            &detail.label,
            detail.created_at,
            detail.expires_at,
            token.parent.clone()
        ];
        tx.execute(sql.into(), values).await?;
        self.commit("token", tx).await
    }

    /// The token with this id.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn token(&self, id: &str) -> Result<Option<Token>> {
        let row = self.query_one(format!("{TOKEN} WHERE id = $1"), values![id]).await?;
        row.as_ref().map(token).transpose()
    }

    /// All tokens but sessions, latest first.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn tokens(&self) -> Result<Vec<TokenDetail>> {
        let rows = self
            .query(format!("{TOKEN} WHERE parent IS NULL ORDER BY created_at DESC, id LIMIT 1000"), vec![])
            .await?;
        rows.iter().map(|row| token(row).map(|token| token.detail)).collect()
    }

    /// Whether there is any token.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn has_tokens(&self) -> Result<bool> {
        Ok(self.query_one("SELECT id FROM token LIMIT 1", vec![]).await?.is_some())
    }

    /// Revokes a token and the sessions that were made from it.
    ///
    /// # Errors
    /// [`Kind::NotFound`].
    pub async fn revoke_token(&self, id: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE token SET revoked_at = COALESCE(revoked_at, $2) WHERE id = $1 OR parent = $1";
        if tx.execute(sql.into(), values![id, now]).await? == 0 {
            return Err(Error::not_found("token", id));
        }
        self.commit("revoke", tx).await
    }

    /// Forgets sessions that have expired.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn forget_sessions(&self, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "DELETE FROM token WHERE parent IS NOT NULL AND (expires_at < $1 OR revoked_at < $1)";
        tx.execute(sql.into(), values![now]).await?;
        self.commit("sessions", tx).await
    }

    /// Notes that a token was used.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn token_used(&self, id: &str, now: i64) -> Result<()> {
        let mut tx = self.begin().await?;
        tx.execute("UPDATE token SET last_used_at = $2 WHERE id = $1".into(), values![id, now]).await?;
        self.commit("token_used", tx).await
    }

    /// Adds a ticket for `uses` workers.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn add_ticket(
        &self,
        id: &str,
        sha256: &str,
        uses: i64,
        labels: &[String],
        expires_at: i64,
    ) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql =
            "INSERT INTO ticket (id, sha256, uses_left, labels, expires_at) VALUES ($1, $2, $3, $4, $5)";
        let labels = serde_json::to_string(labels)?;
        tx.execute(sql.into(), values![id, sha256, uses, labels, expires_at]).await?;
        self.commit("ticket", tx).await
    }

    /// Uses a ticket once, and returns its labels. What was wrong with it is not told.
    ///
    /// # Errors
    /// [`Kind::Unauthorized`].
    pub async fn use_ticket(&self, id: &str, sha256: &str, now: i64) -> Result<Vec<String>> {
        let mut tx = self.begin().await?;
        let sql = "UPDATE ticket SET uses_left = uses_left - 1
            WHERE id = $1 AND sha256 = $2 AND uses_left > 0 AND expires_at > $3 RETURNING labels";
        let rows = tx.query(sql.into(), values![id, sha256, now]).await?;
        let row = rows.first().ok_or_else(|| Error::new(Kind::Unauthorized, "the ticket is not valid"))?;
        let labels = serde_json::from_str(&row.text(0)?)?;
        self.commit("use_ticket", tx).await?;
        Ok(labels)
    }

    /// All projects, by name.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn projects(&self) -> Result<Vec<Project>> {
        let rows = self
            .query(
                "SELECT name, share, running_max, retention_days, outputs_days FROM project ORDER BY name",
                vec![],
            )
            .await?;
        let project = |row: &Row| {
            Ok(Project {
                name: row.text(0)?,
                share: row.int(1)?,
                running_max: row.int_or_null(2)?,
                retention_days: row.int_or_null(3)?,
                outputs_days: row.int_or_null(4)?,
            })
        };
        rows.iter().map(project).collect()
    }

    /// Makes or changes a project.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn put_project(&self, project: &Project) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "INSERT INTO project (name, share, running_max, retention_days, outputs_days)
            VALUES ($1, $2, $3, COALESCE($4, 14), $5)
            ON CONFLICT (name) DO UPDATE SET share = $2, running_max = $3,
                retention_days = COALESCE($4, project.retention_days), outputs_days = COALESCE($5, project.outputs_days)";
        let Project { name, share, running_max, retention_days, outputs_days } = project;
        tx.execute(sql.into(), values![name, *share, *running_max, *retention_days, *outputs_days]).await?;
        self.commit("project", tx).await
    }

    /// Writes a change down.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn add_audit(&self, entry: &AuditEntry) -> Result<()> {
        let mut tx = self.begin().await?;
        let sql = "INSERT INTO audit (at, token_id, actor, address, action, status) VALUES ($1, $2, $3, $4, $5, $6)";
        let AuditEntry { at, actor, token, address, action, status, .. } = entry;
        tx.execute(sql.into(), values![*at, token.clone(), actor, address, action, *status]).await?;
        self.commit("audit", tx).await
    }

    /// Changes before entry `before`, latest first.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn audit(&self, before: i64, limit: i64) -> Result<AuditPage> {
        let sql = "SELECT id, at, actor, token_id, address, action, status FROM audit WHERE id < $1 ORDER BY id DESC LIMIT $2";
        let entry = |row: &Row| {
            Ok(AuditEntry {
                id: row.int(0)?,
                at: row.int(1)?,
                actor: row.text(2)?,
                token: row.text_or_null(3)?,
                address: row.text(4)?,
                action: row.text(5)?,
                status: row.int(6)?,
            })
        };
        let rows = self.query(sql, values![before, limit]).await?;
        let entries = rows.iter().map(entry).collect::<Result<Vec<_>>>()?;
        let next = if entries.len() as i64 == limit { entries.last().map(|entry| entry.id) } else { None };
        Ok(AuditPage { entries, next })
    }
}
